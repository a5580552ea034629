"""Teachers: whoever explains what is less good about a plan; answers are checked before they are used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from clients.labelling.checks import FailedCheck, check_reflection
from clients.labelling.teachers.view import Surroundings
from model.driving.plan import Plan
from model.driving.scene import Scene

ATTEMPTS: Final = 3


class TeacherError(Exception):
    """A teacher that cannot answer a question; the text says what it lacks."""


class ReflectionRefused(Exception):
    """A teacher whose answers failed the checks every time.

    Attributes:
        text: its last answer.
        failed: what was wrong with that.
        attempts: how often it was asked.
    """

    def __init__(self, text: str, failed: Sequence[FailedCheck], attempts: int) -> None:
        super().__init__("; ".join(f"{each.check}: {each.detail}" for each in failed))
        self.text, self.failed, self.attempts = text, tuple(failed), attempts


@dataclass(frozen=True, eq=False)
class Question:
    """What a teacher is asked.

    Attributes:
        scene: what the model saw.
        predicted: the plan that the model made.
        expert: the better plan, which the answer leads to and must not mention.
        surroundings: annotations of the scene, where there are some.
        seed: asked again with another one, a teacher may say it otherwise.
    """

    scene: Scene
    predicted: Plan
    expert: Plan
    surroundings: Surroundings | None = None
    seed: int = 0


class Teacher(Protocol):
    """Explains plans. ``name`` and ``revision`` are the provenance of what it writes."""

    @property
    def name(self) -> str:
        """Who it is."""
        ...

    @property
    def revision(self) -> str:
        """Changes when it would write something else."""
        ...

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> str:
        """One paragraph; ``complaints`` say what was wrong with earlier ones. Raises `TeacherError`."""
        ...


@dataclass(frozen=True)
class Reflection:
    """An answer that passed all checks; ``failed`` are those that earlier answers did not pass."""

    text: str
    attempts: int
    failed: tuple[FailedCheck, ...]


async def ask(teacher: Teacher, question: Question, attempts: int = ATTEMPTS) -> Reflection:
    """A teacher's checked answer; it is asked again with what was wrong, a few times.

    Raises:
        TeacherError: it cannot answer.
        ReflectionRefused: none of its answers passed the checks.
    """
    complaints: list[FailedCheck] = []
    for attempt in range(1, attempts + 1):
        text = await teacher.reflect(question, complaints)
        failed = check_reflection(text, question.predicted, question.expert)
        if not failed:
            return Reflection(text, attempt, tuple(complaints))
        complaints += failed
    raise ReflectionRefused(text, failed, attempts)
