from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest

from looktwice.clients.labelling.checks import FailedCheck
from looktwice.clients.labelling.teachers.rules import RuleTeacher
from looktwice.clients.labelling.teachers.teacher import (
    ATTEMPTS,
    Answer,
    Question,
    ReflectionRefused,
    TeacherBusy,
    ask,
)
from looktwice.model.bundled import SCENES
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.view import Surroundings

SCENE, OTHER = list(read_scenes(SCENES, dense=False))[:2]
QUESTION = Question(
    SCENE.scene,
    expert_plan(OTHER),
    expert_plan(SCENE),
    Surroundings.of(SCENE),
)
GOOD = asyncio.run(RuleTeacher().reflect(QUESTION))
LEAKING = Answer("The expert does it otherwise on this road.", 10, 5)


class Stubborn:
    """Answers in turn, the last answer for ever, and remembers what it was told."""

    name, revision = "stubborn", "1"

    def __init__(self, *answers: Answer | Exception) -> None:
        self.answers, self.told = list(answers), list[Sequence[FailedCheck]]()

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        self.told.append(list(complaints))
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def close(self) -> None:
        pass


def test_a_teacher_is_asked_again_with_what_was_wrong() -> None:
    teacher = Stubborn(Answer("The expert does it otherwise"), GOOD)
    answer = asyncio.run(ask(teacher, QUESTION, []))
    assert (answer.text, answer.attempts) == (GOOD.text, 2)
    assert {"leak", "form"} <= {failed.check for failed in answer.failed}
    assert teacher.told == [[], list(answer.failed)]


def test_a_teacher_that_does_not_learn_is_refused() -> None:
    teacher = Stubborn(Answer("The expert does it otherwise"), LEAKING)
    with pytest.raises(ReflectionRefused, match="leak") as refused:
        asyncio.run(ask(teacher, QUESTION, []))
    assert refused.value.attempts == ATTEMPTS == len(teacher.told)
    assert refused.value.text == LEAKING.text
    assert "form" in {failed.check for failed in refused.value.failed}, "earlier answers count too"
    assert "form" not in str(refused.value)


def test_what_is_no_answer_counts_as_one_that_failed() -> None:
    teacher = Stubborn(Answer("", unusable="nothing came"), GOOD)
    answer = asyncio.run(ask(teacher, QUESTION, []))
    assert answer.attempts == 2
    assert answer.failed == (FailedCheck("answer", "nothing came"),)


def test_answers_are_kept_as_they_come_and_not_asked_for_again() -> None:
    kept: list[Answer] = []
    answers: list[Answer] = []
    teacher = Stubborn(LEAKING, TeacherBusy("later"), GOOD)

    def keep(attempt: int, answer: Answer) -> None:
        assert attempt == len(kept) + 1
        kept.append(answer)

    with pytest.raises(TeacherBusy):
        asyncio.run(ask(teacher, QUESTION, answers, keep))
    assert kept == answers == [LEAKING]
    reflection = asyncio.run(ask(teacher, QUESTION, answers, keep))
    assert reflection.attempts == 2
    assert kept == answers == [LEAKING, GOOD]
    assert len(teacher.told) == 3, "the first answer was not asked for again"
    assert teacher.told[2] == teacher.told[1]
