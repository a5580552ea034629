"""A teacher behind POST /v1/label, over a real socket."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from looktwice.clients.labelling.checks import FailedCheck
from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.clients.labelling.teachers.rules import RuleTeacher
from looktwice.clients.labelling.teachers.service import ServiceTeacher
from looktwice.clients.labelling.teachers.teacher import (
    Answer,
    Question,
    Teacher,
    TeacherBusy,
    TeacherClosed,
    TeacherError,
)
from looktwice.model.driving.outcome import Outcome
from looktwice.model.driving.view import Surroundings
from looktwice.service.operations.settings import Settings
from tests.clients.labelling.builds import GOOD, LEAKING, ChatServer
from tests.service.scenes import labelled
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN, ScriptedEngine
from tests.service.serving import serve
from tests.sockets import listening

SCENE = labelled()
QUESTION = Question(SCENE.scene, KEEP_ON, SLOW_DOWN, Surroundings.of(SCENE))


class Other(RuleTeacher):
    """Changes its revision once it has answered."""

    revision = "1"  # type: ignore[misc]  # what a class keeps for good, an object of a test may change

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        answer = await super().reflect(question, complaints)
        self.revision = "2"  # type: ignore[misc]
        return answer


class Seeded(RuleTeacher):
    """Tells the seed that it is asked with."""

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        return (await super().reflect(question, complaints))._replace(input_tokens=question.seed)


class Hinted(RuleTeacher):
    """Tells a tenth of the second at which the plan that it is asked about collides."""

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        collided_s = None if question.outcome is None else question.outcome.collided_s
        return (await super().reflect(question, complaints))._replace(
            input_tokens=round(10 * (collided_s or 0))
        )


def asked(
    tmp_path: Path, teacher: Teacher, question: Question = QUESTION, complaints: tuple[FailedCheck, ...] = ()
) -> tuple[str, str, Answer]:
    async def asking(url: str) -> tuple[str, str, Answer]:
        remote = await ServiceTeacher.connect(url)
        try:
            return remote.name, remote.revision, await remote.reflect(question, complaints)
        finally:
            await remote.close()

    with serve(ScriptedEngine(), Settings(bundled_scenes=tmp_path / "none"), teacher=teacher) as served:
        return asyncio.run(asking(served.url))


def test_it_answers_as_the_teacher_behind_it(tmp_path: Path) -> None:
    name, revision, answer = asked(tmp_path, RuleTeacher())
    assert (name, revision) == (RuleTeacher.name, RuleTeacher.revision)
    assert answer == asyncio.run(RuleTeacher().reflect(QUESTION))
    again = asked(tmp_path, Seeded(), complaints=(FailedCheck("leak", "x"), FailedCheck("form", "y")))
    assert again[2].input_tokens == 2, "asked again, it is asked with another seed"


def test_what_the_plan_failed_at_goes_with_the_question(tmp_path: Path) -> None:
    outcome = Outcome(("collision",), 2.1, "moving vehicle", None, None, None, None, 12.0, 30.0)
    assert asked(tmp_path, Hinted(), replace(QUESTION, outcome=outcome))[2].input_tokens == 21


def test_a_vision_language_model_behind_the_service(tmp_path: Path) -> None:
    server = ChatServer([LEAKING, GOOD])
    with listening(server.app()) as (url, _):
        teacher = OpenAiTeacher(OpenAiSettings(f"{url}/v1", "some-vlm", input_price_usd=1.0))
        name, _, answer = asked(tmp_path, teacher, Question(SCENE.scene, KEEP_ON, SLOW_DOWN))
    assert name == "openai:some-vlm"
    assert answer._replace(cost_usd=0) == Answer(GOOD, 2000, 100), "both answers are counted"
    assert answer.cost_usd == pytest.approx(0.002)
    assert len(server.asked) == 2


def test_a_refused_label_is_no_answer(tmp_path: Path) -> None:
    server = ChatServer([LEAKING])
    with listening(server.app()) as (url, _):
        answer = asked(tmp_path, OpenAiTeacher(OpenAiSettings(f"{url}/v1", "some-vlm")))[2]
    assert answer.text == ""
    assert "leak" in answer.unusable


def test_what_the_teacher_lacks_is_told(tmp_path: Path) -> None:
    with pytest.raises(TeacherError, match="annotations") as lacking:
        asked(tmp_path, RuleTeacher(), Question(SCENE.scene, KEEP_ON, SLOW_DOWN))
    assert not isinstance(lacking.value, TeacherBusy | TeacherClosed)


def test_a_closed_endpoint_is_the_service_being_busy(tmp_path: Path) -> None:
    server = ChatServer([(401, {})])
    with listening(server.app()) as (url, _), pytest.raises(TeacherBusy, match="does not answer"):
        asked(tmp_path, OpenAiTeacher(OpenAiSettings(f"{url}/v1", "some-vlm")))


def test_another_teacher_than_at_first_is_noticed(tmp_path: Path) -> None:
    with pytest.raises(TeacherClosed, match="rules 2"):
        asked(tmp_path, Other())


def test_nobody_there() -> None:
    with pytest.raises(TeacherClosed, match="no service"):
        asyncio.run(ServiceTeacher.connect("http://127.0.0.1:9"))
