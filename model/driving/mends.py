"""Mends: how a trajectory that fails when it is followed may be changed, from the smallest change on.

A change of the pace keeps the way, and a change of the way keeps the pace; the last mend is to do all as the
expert does. Which one is enough is found out in the simulator (`looktwice build outcomes`), so that a second
look asks for no more than is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, get_args

import numpy as np

from looktwice.model.driving.labeller import label_plan
from looktwice.model.driving.plan import GROUPS, Group, Plan
from looktwice.model.driving.trajectory import (
    FUTURE_STEPS,
    STEP_S,
    FloatArray,
    paced,
    present_speed,
    retimed,
    speeds,
)

MENDS_VERSION: Final = 1
"""Raised when a mend changes a trajectory otherwise."""

Mend = Literal[
    "ease off",
    "slow down",
    "speed up",
    "accelerate",
    "brake",
    "brake hard",
    "the expert's pace",
    "the expert's way",
    "the expert's",
]
MENDS: Final[tuple[Mend, ...]] = get_args(Mend)
Alternative = Mend | Literal["the route's way"]
"""What else may be driven. A trajectory's pace in the middle of the route is no mend that words tell yet."""

SLOWER_SHARE: Final[Mapping[Mend, float]] = {"ease off": 0.25, "slow down": 0.4}
"""So much slower than before ..."""
SLOWING_S: Final = 3.2
"""... from so many seconds on."""
FASTER_MS2: Final[Mapping[Mend, float]] = {"speed up": 0.7, "accelerate": 1.4}
"""On top of what the trajectory does."""
BRAKE_MS2: Final[Mapping[Mend, float]] = {"brake": 2.0, "brake hard": 3.5}
"""From now on."""
_TIMES_S: Final = STEP_S * np.arange(1, FUTURE_STEPS + 1)


def mended(mend: Mend, trajectory: FloatArray, expert: FloatArray, history: FloatArray) -> FloatArray:
    """A trajectory [64, 4] with a mend.

    Args:
        mend: to make.
        trajectory: float32 [64, 4].
        expert: float32 [64, 4], the expert's.
        history: float32 [16, 4], where both come from.
    """
    if mend == "the expert's":
        return expert
    if mend == "the expert's pace":
        return retimed(trajectory, expert)
    if mend == "the expert's way":
        return retimed(expert, trajectory)
    pace = speeds(trajectory)
    if mend in SLOWER_SHARE:
        pace = pace * (1 - SLOWER_SHARE[mend] * np.minimum(_TIMES_S / SLOWING_S, 1))
    elif mend in FASTER_MS2:
        pace = pace + FASTER_MS2[mend] * _TIMES_S
    else:
        braked = present_speed(history) - BRAKE_MS2[mend] * _TIMES_S
        pace = np.minimum(pace, np.maximum(braked, 0))
    return paced(trajectory, pace)


def mended_plan(mend: Mend, plan: Plan, trajectory: FloatArray, expert: Plan, history: FloatArray) -> Plan:
    """The plan that a mended trajectory carries out.

    Args:
        mend: that was made.
        plan: before; tracks that the mend does not change are as they were.
        trajectory: float32 [64, 4], the mended one.
        expert: the expert's plan; a trajectory alone does not tell lanes.
        history: float32 [16, 4].
    """
    if mend == "the expert's":
        return expert
    told = label_plan(trajectory, history, None)
    changed = Plan(told.longitudinal, told.lateral, expert.lane)
    groups = groups_of(mend)
    return Plan(**{group: (changed if group in groups else plan).track(group) for group in GROUPS})


def groups_of(mend: Mend) -> frozenset[Group]:
    """The tracks of a plan that a mend may change."""
    way: frozenset[Group] = frozenset({"lateral", "lane"})
    pace: frozenset[Group] = frozenset({"longitudinal"})
    return {"the expert's": way | pace, "the expert's way": way}.get(mend, pace)


def mend_within(mend: Mend, groups: frozenset[Group]) -> Mend | None:
    """What is left of a mend if only some tracks may change; None where nothing is."""
    left = groups_of(mend) & groups
    if mend == "the expert's" and left:
        if "longitudinal" not in left:
            return "the expert's way"
        if left == {"longitudinal"}:
            return "the expert's pace"
    return mend if left else None
