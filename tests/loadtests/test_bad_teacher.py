"""The bad teacher of `costly`, asked by the real one's client."""

from __future__ import annotations

import asyncio

import httpx
import pytest

from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.clients.labelling.teachers.teacher import Question, TeacherBusy, TeacherError
from looktwice.loadtests.bad_teacher import bad_teacher
from tests.service.scenes import scene
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN

QUESTION = Question(scene(), KEEP_ON, SLOW_DOWN)


def test_it_answers_in_all_its_ways_in_turn() -> None:
    async def asking(url: str) -> None:
        teacher = OpenAiTeacher(OpenAiSettings(url, "some-vlm", timeout_s=3.0))
        with pytest.raises(TeacherError, match="more than"):
            await teacher.reflect(QUESTION)
        with pytest.raises(TeacherBusy, match="no whole answer"):
            await teacher.reflect(QUESTION)
        with pytest.raises(TeacherBusy, match="503") as busy:
            await teacher.reflect(QUESTION)
        assert busy.value.wait_s == 0.0
        answer = await teacher.reflect(QUESTION)
        assert (answer.text, answer.input_tokens) == ("", 0)
        assert answer.unusable
        await teacher.close()

    with bad_teacher() as teacher:
        asyncio.run(asking(teacher.url))
        assert set(teacher.asked.values()) == {1}
        assert len(teacher.asked) == 4
    with pytest.raises(httpx.ConnectError):
        httpx.get(teacher.url)
