"""A request as it is sent, what its answer says, and what became of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal, get_args

from pydantic import BaseModel, ValidationError

from looktwice.clients.wire import Deadline
from looktwice.loadtests.mix import RequestKind


@dataclass(frozen=True)
class Call:
    """What goes over the wire.

    Attributes:
        kind: what it asks for.
        path: of the endpoint.
        headers: names and values, besides those of the target.
        body: written as the kind's payload says.
    """

    kind: RequestKind
    path: str
    headers: tuple[tuple[str, str], ...]
    body: bytes = field(repr=False)


Outcome = Literal["answered", "rejected", "failed", "missed"]
"""``rejected``: the service refused for load (429). ``failed``: everything else without a good answer.
``missed``: never sent, since a planner of a closed loop was still waiting when it was due."""
OUTCOMES: Final[tuple[Outcome, ...]] = get_args(Outcome)

Branch = Literal["direct", "think", "reflect", "label", "batch", "imagine"]
BRANCHES: Final[tuple[Branch, ...]] = get_args(Branch)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What an answer says.

    Attributes:
        outcome: see `Outcome`.
        problem: the last part of the problem's type, or what else kept the answer away; empty when answered.
        branch: ``think`` where any draw thought, ``direct`` where none did; reflections, labels, batches and
            imagined pictures are kinds of their own. None unless answered.
        deadline_met, cut: as the service tells them; None without a deadline.
    """

    outcome: Outcome
    problem: str = ""
    branch: Branch | None = None
    deadline_met: bool | None = None
    cut: int | None = None


MISSED: Final = Verdict("missed", "still-waiting")


@dataclass(frozen=True, slots=True)
class Exchange:
    """One request on the clock of its run, in seconds from the run's start.

    Attributes:
        kind: what was asked.
        due_s: when it was to be sent; latency counts from here.
        sent_s: when it was sent; NaN where it never was.
        ended_s: when the answer's last byte, or the failure, was there.
        verdict: what came.
        first_plan_s: when a stream's first plan, or its first picture, was there; None elsewhere.
    """

    kind: RequestKind
    due_s: float
    sent_s: float
    ended_s: float
    verdict: Verdict
    first_plan_s: float | None = None

    @property
    def latency_s(self) -> float:
        """From when it was due, not from when it was sent: a generator that is late hides nothing."""
        return self.ended_s - self.due_s

    @property
    def lag_s(self) -> float:
        """How late it was sent."""
        return self.sent_s - self.due_s

    def within_s(self, goal_s: float) -> float:
        """The latency it should have: its own deadline, or the run's goal."""
        return goal_s if self.kind.deadline_ms is None else self.kind.deadline_ms / 1000

    def good(self, goal_s: float) -> bool:
        """Answered in time."""
        return self.verdict.outcome == "answered" and self.latency_s <= self.within_s(goal_s)


TOO_MANY_REQUESTS: Final = 429
BAD_ANSWER: Final = Verdict("failed", "bad-answer")


class _Draw(BaseModel):
    thinking: str | None = None


class _Planned(BaseModel):
    draws: list[_Draw]
    deadline: Deadline | None = None


class _Labelled(BaseModel):
    reflection: str


class _Picture(BaseModel):
    image: str
    codes: list[int]


class _Imagined(BaseModel):
    pictures: list[_Picture]


class _BatchResult(BaseModel):
    status: int


class _Batch(BaseModel):
    results: list[_BatchResult]


class _Problem(BaseModel):
    type: str


def read_answer(kind: RequestKind, status: int, content: bytes) -> Verdict:
    """The verdict on a whole answer: its status and body, or those a stream ended with."""
    if status != 200:
        return refusal(status, content)
    try:
        if kind.work == "label":
            _Labelled.model_validate_json(content)
            return Verdict("answered", branch="label")
        if kind.work == "batch":
            return _batch([result.status for result in _Batch.model_validate_json(content).results])
        if kind.work == "imagine":
            pictures = _Imagined.model_validate_json(content).pictures
            return Verdict("answered", branch="imagine") if len(pictures) == kind.n else BAD_ANSWER
        return _planned(kind, _Planned.model_validate_json(content))
    except ValidationError:
        return BAD_ANSWER


def refusal(status: int, content: bytes) -> Verdict:
    """The verdict on an answer that is none; the problem's name, or its status where it has none."""
    try:
        name = _Problem.model_validate_json(content).type.rsplit("/", 1)[-1]
    except ValidationError:
        name = f"http-{status}"
    return Verdict("rejected" if status == TOO_MANY_REQUESTS else "failed", name)


def _planned(kind: RequestKind, answer: _Planned) -> Verdict:
    if len(answer.draws) != kind.n:
        return BAD_ANSWER
    branch: Branch = "think" if any(draw.thinking is not None for draw in answer.draws) else "direct"
    met, cut = (answer.deadline.met, len(answer.deadline.cut)) if answer.deadline else (None, None)
    return Verdict(
        "answered", branch="reflect" if kind.work == "reflect" else branch, deadline_met=met, cut=cut
    )


def _batch(statuses: list[int]) -> Verdict:
    """A batch is as good as its worst part."""
    worst = max(statuses, default=0)
    if worst == 200:
        return Verdict("answered", branch="batch")
    rejected = TOO_MANY_REQUESTS in statuses
    return Verdict("rejected" if rejected else "failed", f"http-{TOO_MANY_REQUESTS if rejected else worst}")
