"""What became of one request."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

from loadtests.mix import Kind

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

    kind: Kind
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
