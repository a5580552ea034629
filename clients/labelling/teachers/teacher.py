"""Teachers: whoever explains what is less good about a plan; answers are checked before they are used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from looktwice.clients.labelling.checks import FailedCheck, check_reflection
from looktwice.clients.retries import TryLater
from looktwice.model.driving.outcome import Outcome
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.view import Surroundings

ATTEMPTS: Final = 3


class TeacherError(Exception):
    """A teacher that cannot answer a question; the text says what it lacks."""


class TeacherBusy(TeacherError, TryLater):
    """A teacher that has no time, or is not there now: the same question may be answered later."""


class AnnotationsMissing(TeacherError):
    """A teacher that needs to be told who is around in the scene."""


class NothingInView(TeacherError):
    """A teacher that sees nothing that asks for the better plan, and makes up no reason."""


class TeacherClosed(TeacherError):
    """A teacher that answers nobody as things are set up: a wrong key, model or address."""


class ReflectionRefused(Exception):
    """A teacher whose answers failed the checks every time.

    Attributes:
        text: its last answer.
        failed: what was wrong with all of them.
        attempts: how often it was asked.
    """

    def __init__(
        self, text: str, last: Sequence[FailedCheck], failed: Sequence[FailedCheck], attempts: int
    ) -> None:
        super().__init__("; ".join(f"{each.check}: {each.detail}" for each in last))
        self.text, self.failed, self.attempts = text, tuple(failed), attempts


class Answer(NamedTuple):
    """What a teacher wrote, and what that took.

    Attributes:
        text: as it came; unchecked.
        input_tokens, output_tokens, cost_usd: as the teacher counts; 0 where it does not.
        unusable: why it is no answer; empty where it is one.
    """

    text: str
    input_tokens: int = 0
    output_tokens: int = 0
    cost_usd: float = 0.0
    unusable: str = ""


@dataclass(frozen=True, eq=False)
class Question:
    """What a teacher is asked.

    Attributes:
        scene: what the model saw.
        predicted: the plan that the model made.
        expert: the better plan, which the answer leads to and must not mention.
        surroundings: annotations of the scene, where there are some.
        seed: asked again with another one, a teacher may say it otherwise.
        outcome: what the predicted plan came to when it was followed, where that is known and it failed: a
            hint at what to look for, which no driver can know and no answer may tell.
    """

    scene: Scene
    predicted: Plan
    expert: Plan
    surroundings: Surroundings | None = None
    seed: int = 0
    outcome: Outcome | None = None


class Teacher(Protocol):
    """Explains plans. ``name`` and ``revision`` are the provenance of what it writes."""

    @property
    def name(self) -> str:
        """Who it is."""
        ...

    @property
    def revision(self) -> str:
        """Changes when it would write something else: model, prompt, sampling."""
        ...

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        """One paragraph; ``complaints`` say what was wrong with earlier ones.

        Raises:
            TeacherError: it cannot answer; `TeacherBusy` where it could later, `TeacherClosed` where no
                question would be answered.
        """
        ...

    async def close(self) -> None:
        """Nothing more will be asked."""
        ...


@dataclass(frozen=True)
class CheckedReflection:
    """An answer that passed all checks; ``failed`` are those that earlier answers did not pass."""

    text: str
    attempts: int
    failed: tuple[FailedCheck, ...]


async def ask(
    teacher: Teacher,
    question: Question,
    answers: list[Answer],
    keep: Callable[[int, Answer], None] = lambda attempt, answer: None,
) -> CheckedReflection:
    """A teacher's checked answer; it is asked again with what was wrong, `ATTEMPTS` times in all.

    Args:
        teacher: who is asked.
        question: what.
        answers: that it gave before to this question, in order; new ones are added, so that asking goes on
            where it was broken off.
        keep: told of each new answer, with its number from 1 on, before anything is made of it.

    Raises:
        TeacherError: it cannot answer.
        ReflectionRefused: none of its answers passed the checks.
    """
    while not isinstance(verdict := judge(question, answers), CheckedReflection):
        answers.append(await teacher.reflect(question, verdict))
        keep(len(answers), answers[-1])
    return verdict


def judge(question: Question, answers: Sequence[Answer]) -> CheckedReflection | tuple[FailedCheck, ...]:
    """The first answer that passes all checks, or what to tell the teacher when it is asked again.

    Raises:
        ReflectionRefused: it was asked `ATTEMPTS` times already.
    """
    complaints: list[FailedCheck] = []
    for attempt, answer in enumerate(answers, 1):
        failed = (
            [FailedCheck("answer", answer.unusable)]
            if answer.unusable
            else check_reflection(answer.text, question.predicted, question.expert)
        )
        if not failed:
            return CheckedReflection(answer.text, attempt, tuple(complaints))
        complaints += failed
        if attempt == ATTEMPTS:
            raise ReflectionRefused(answer.text, failed, complaints, ATTEMPTS)
    return tuple(complaints)
