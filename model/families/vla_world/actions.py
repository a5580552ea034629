"""What six waypoints do, in VLA-World's words for direction and speed (figure 5b; table 3 counts them).

The paper publishes no thresholds. Directions are those of nuScenes's open-loop commands: left or right of the
present heading by 2 m within 3 s. Speeds are compared between the first and the last half second.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.trajectory import TEN_HZ_S, FloatArray, at_times
from looktwice.model.families.family import Actions
from looktwice.model.families.vla_world.format import DIRECTIONS, TIMES_S, Direction, Lateral, Speed

SIDE_M: Final = 2.0
"""Metres to a side after 3 s that make a turn."""
STOPPED_MS: Final = 0.5
"""Who is slower in the end stops, as in plans (`looktwice.model.driving.labeller`)."""
CHANGED_MS: Final = 1.0
"""A change of speed by less is none: waypoints in decimetres tell 0.2 m/s."""
QUICK: Final = 2.0
"""A change by this factor is a quick one."""

COUNTED_SPEED: Final[Mapping[Speed, str]] = MappingProxyType(
    {
        "A CONSTANT SPEED": "keep",
        "AN ACCELERATION": "accelerate",
        "A QUICK ACCELERATION": "accelerate",
        "A DECELERATION": "decelerate",
        "A QUICK DECELERATION": "decelerate",
        "A DECELERATION TO ZERO": "stop",
    }
)
"""What table 3 counts: how quick a change is does not matter."""
_STEP_S: Final = TIMES_S[0]
_DIRECTION_OF: Final[Mapping[Lateral, Direction]] = MappingProxyType(
    {"MOVE FORWARD": "Forward", "TURN LEFT": "Left", "TURN RIGHT": "Right"}
)


@dataclass(frozen=True)
class Action:
    """A direction and what happens to the speed."""

    lateral: Lateral
    speed: Speed

    @property
    def direction(self) -> Direction:
        """The same way in the words of predictions."""
        return _DIRECTION_OF[self.lateral]


def counted(action: Action) -> tuple[str, ...]:
    """The words that table 3 counts of an action: direction and speed."""
    return action.direction.lower(), COUNTED_SPEED[action.speed]


def counted_of(trajectory: FloatArray) -> tuple[str, ...]:
    """The same of a trajectory [64, 4] at 10 Hz."""
    return counted(action_of(at_times(trajectory, TEN_HZ_S, TIMES_S)[:, :2]))


ACTIONS: Final = Actions(
    (tuple(map(str.lower, DIRECTIONS)), tuple(dict.fromkeys(COUNTED_SPEED.values()))), counted_of
)


def action_of(waypoints_m: npt.ArrayLike) -> Action:
    """What waypoints [6, 2] in the ego frame (ahead, left) do, half a second apart."""
    points = np.concatenate([np.zeros((1, 2)), np.asarray(waypoints_m, np.float64)])
    speeds_ms = np.linalg.norm(np.diff(points, axis=0), axis=1) / _STEP_S
    return Action(_lateral(float(points[-1, 1])), _speed(float(speeds_ms[0]), float(speeds_ms[-1])))


def _lateral(left_m: float) -> Lateral:
    if abs(left_m) < SIDE_M:
        return "MOVE FORWARD"
    return "TURN LEFT" if left_m > 0 else "TURN RIGHT"


def _speed(first_ms: float, last_ms: float) -> Speed:
    if last_ms < STOPPED_MS:
        return "A DECELERATION TO ZERO"
    if abs(last_ms - first_ms) < CHANGED_MS:
        return "A CONSTANT SPEED"
    if last_ms > first_ms:
        return "A QUICK ACCELERATION" if last_ms > QUICK * first_ms else "AN ACCELERATION"
    return "A QUICK DECELERATION" if first_ms > QUICK * last_ms else "A DECELERATION"
