"""Whether the parts of a response agree: reasoning, change of plan, view and trajectory.

Used alike by the service (every answer says so), by `looktwice evaluate` and by the checks of labelled data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

from looktwice.model.driving.claims import claims, unfounded
from looktwice.model.driving.direction import agrees, requested_changes
from looktwice.model.driving.labeller import label_plan
from looktwice.model.driving.phrases import agrees as changes_as_stated
from looktwice.model.driving.phrases import facts_of
from looktwice.model.driving.plan import Plan, plan_iou
from looktwice.model.driving.seen import all_shown
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray
from looktwice.model.driving.view import View

Parts = Literal["plan_trajectory", "reason_change"]
"""Two parts of a response that can be held against each other without knowing the scene."""
PARTS: Final[tuple[Parts, ...]] = get_args(Parts)

FOLLOWS_IOU: Final = 0.6
"""A trajectory follows its plan when what it carries out has at least this IOU with it.

Of the two tracks that a trajectory tells, half of one is then said otherwise. 96 % of the expert's own plans
pass when its trajectory went through the codec (200 validation scenes).
"""


@dataclass(frozen=True)
class Agreement:
    """Which parts of a response agree; a pair of which nothing can be said is in neither.

    Attributes:
        agreeing, disagreeing: pairs of parts.
    """

    agreeing: frozenset[Parts]
    disagreeing: frozenset[Parts]

    @property
    def consistent(self) -> bool | None:
        """Whether nothing disagrees; None where nothing can be said."""
        if self.disagreeing:
            return False
        return True if self.agreeing else None

    @property
    def disagreements(self) -> tuple[Parts, ...]:
        """The pairs that do not agree, in the order of `PARTS`."""
        return tuple(part for part in PARTS if part in self.disagreeing)


def agreement(
    plan: Plan | None,
    thinking: str | None,
    revised: Plan | None,
    trajectory: FloatArray,
    history: FloatArray,
) -> Agreement:
    """Hold the parts of a response against each other.

    Args:
        plan: the first plan, where there is one.
        thinking, revised: reasoning and the plan behind it; None without a second look.
        trajectory: float32 [t, 4] at 10 Hz.
        history: float32 [16, 4] of the scene.
    """
    verdicts: dict[Parts, bool | None] = {}
    iou = trajectory_iou(revised or plan, trajectory, history)
    verdicts["plan_trajectory"] = None if iou is None else iou >= FOLLOWS_IOU
    verdicts["reason_change"] = None
    if plan is not None and thinking is not None and revised is not None:
        verdicts["reason_change"] = reason_and_change(thinking, plan, revised)
    return Agreement(
        frozenset(part for part, verdict in verdicts.items() if verdict is True),
        frozenset(part for part, verdict in verdicts.items() if verdict is False),
    )


def trajectory_iou(plan: Plan | None, trajectory: FloatArray, history: FloatArray) -> float | None:
    """IOU of a plan with what a trajectory carries out, over the tracks that both tell.

    The labeller cannot tell lanes from a trajectory alone, so the lane track does not count. None for a
    plan without a longitudinal and a lateral track, and for a trajectory that ends before its plan.
    """
    if plan is None or len(trajectory) < FUTURE_STEPS:
        return None
    carried_out = label_plan(trajectory, history, None)
    said, done = (
        Plan(**{group: track for group, track in one.tracks() if other.track(group) is not None})
        for one, other in ((plan, carried_out), (carried_out, plan))
    )
    return plan_iou(said, done) if said.tracks() else None


def reason_and_change(thinking: str, plan: Plan, revised: Plan) -> bool | None:
    """Whether the revised plan changes as the reasoning asks for.

    A reasoning in phrases is compared by its facts: the plan changes in the stated directions and in no
    other. Free text is read as English, see `direction.agrees`; None where the plan stays as it is and the
    text asks for nothing.
    """
    if (facts := facts_of(thinking)) is not None:
        return changes_as_stated(facts, plan, revised)
    if plan == revised:
        return False if requested_changes(thinking) else None
    return agrees(thinking, plan, revised)


def reason_and_view(thinking: str, view: View) -> bool | None:
    """Whether everything that a reasoning says is to be seen is in view; None where it says nothing of it."""
    if (facts := facts_of(thinking)) is not None:
        return all_shown(facts, view)
    return not unfounded(thinking, view) if claims(thinking) else None
