from __future__ import annotations

import asyncio
import re
from pathlib import Path

import pytest
from pydantic import ValidationError

from looktwice.clients.labelling.teachers.feedback_teacher import FeedbackQuestion
from looktwice.clients.labelling.teachers.openai import OpenAiTeacher
from looktwice.clients.labelling.teachers.teacher import Question
from looktwice.clients.wire import Controls
from looktwice.service.operations.settings import Settings, TeacherSettings
from tests.clients.labelling.builds import GOOD, ChatServer
from tests.service.scenes import scene
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN
from tests.sockets import listening

ROOT = Path(__file__).parents[3]


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


def test_a_reasoning_model_is_asked_as_the_docs_say_for_reflections_and_for_feedback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    page = (ROOT / "docs" / "labelling.md").read_text()
    (said,) = re.findall(r"`LOOKTWICE_TEACHER_EXTRA_BODY='(.+)'`", page)
    monkeypatch.setenv("LOOKTWICE_TEACHER_EXTRA_BODY", said)
    monkeypatch.setenv("LOOKTWICE_TEACHER_KIND", "openai")
    monkeypatch.setenv("LOOKTWICE_TEACHER_MODEL", "reasons")
    server = ChatServer([GOOD])

    async def ask_both() -> None:
        teacher = TeacherSettings().teacher()
        assert isinstance(teacher, OpenAiTeacher)
        try:
            await teacher.reflect(Question(scene(), KEEP_ON, SLOW_DOWN))
            await teacher.write_feedback(FeedbackQuestion("It brakes too late.", (), ()))
        finally:
            await teacher.close()

    with listening(server.app()) as (url, _):
        monkeypatch.setenv("LOOKTWICE_TEACHER_BASE_URL", f"{url}/v1")
        asyncio.run(ask_both())
    assert len(server.asked) == 2
    for asked in server.asked:
        assert not {"max_tokens", "temperature"} & asked.keys()
        assert asked["max_completion_tokens"] == 2000
