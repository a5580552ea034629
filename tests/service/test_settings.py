from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from clients.wire import Controls
from service.settings import Settings


def test_settings_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOOKTWICE_MAX_BODY_BYTES", "1000")
    monkeypatch.setenv("LOOKTWICE_BUNDLED_SCENES", "/somewhere/else.parquet")
    settings = Settings()
    assert settings.max_body_bytes == 1000
    assert settings.bundled_scenes == Path("/somewhere/else.parquet")


def test_nonsense_is_refused_at_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOOKTWICE_MAX_BODY_BYTES", "-1")
    with pytest.raises(ValidationError):
        Settings()


def test_by_default_callers_who_come_close_together_are_let_in() -> None:
    assert Settings().max_draws >= 4 * Controls().n
