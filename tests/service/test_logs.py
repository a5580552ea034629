from __future__ import annotations

import json

import pytest
import structlog

from service.logs import configure_logging


def fail() -> None:
    pictures = "x" * 100_000
    raise ValueError(f"about {len(pictures)}")


@pytest.mark.parametrize("log_format", ["json", "console"])
def test_errors_are_logged_without_the_callers_data(
    log_format: str, capsys: pytest.CaptureFixture[str]
) -> None:
    configure_logging("json" if log_format == "json" else "console")
    try:
        fail()
    except ValueError:
        structlog.stdlib.get_logger().exception("failed", scene="a")
    written = capsys.readouterr().err
    assert "about 100000" in written
    assert "xxxx" not in written
    if log_format == "json":
        line = json.loads(written)
        assert (line["event"], line["level"], line["scene"]) == ("failed", "error", "a")
