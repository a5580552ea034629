"""How a plan goes over the 4 s that are scored: speeds, where it ends, how far it turns; and in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from looktwice.model.driving.pdm.profiles import wrapped
from looktwice.model.driving.pdm.world import STEP_S, STEPS, Array

Longitudinal = Literal["accelerate", "decelerate", "maintain speed", "stop"]
Lateral = Literal["keep lane", "turn left", "turn right", "change to left lane", "change to right lane"]

_HORIZON_S: Final = STEPS * STEP_S
_STANDING_MPS: Final = 0.5
_STEADY_MPS2: Final = 0.25
"""Mean acceleration over the 4 s below which a driver holds the speed."""
_TURN_RAD: Final = float(np.deg2rad(15))
_LANE_SHIFT_M: Final = 2.0
"""Sideways, beyond what a bend explains; lanes are 3 m to 3.75 m wide."""
_PERIODS_S: Final = {8: 0.5, 64: 0.1}


@dataclass(frozen=True)
class Course:
    """How a plan goes, in the ego frame of now.

    Attributes:
        speed_mps, end_speed_mps, mean_speed_mps: now, at 4 s and in between.
        ahead_m, left_m: where it is at 4 s.
        turned_rad: the heading then, counter-clockwise.
        longitudinal, lateral: the same as high-level actions (ELF-VLA section 9.1), by its shape alone.
    """

    speed_mps: float
    end_speed_mps: float
    mean_speed_mps: float
    ahead_m: float
    left_m: float
    turned_rad: float
    longitudinal: Longitudinal
    lateral: Lateral


def course_of(plan: Array, ego: Array, ahead_m: float = 0.0) -> Course:
    """The course of a ``plan`` [8, 3] or [64, 3] that begins in the state ``ego`` [11].

    Its poses are those of a point ``ahead_m`` ahead of the rear axle, as that of the box's centre is.
    """
    period_s = _PERIODS_S[len(plan)]
    until = round(_HORIZON_S / period_s)
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    start = ego[:3] + ahead_m * np.array([cos, sin, 0.0])
    poses = np.concatenate([start[None], plan[:until]])
    steps = np.diff(poses[:, :2], axis=0)
    headings = poses[:-1, 2] + wrapped(np.diff(poses[:, 2])) / 2
    forward = steps[:, 0] * np.cos(headings) + steps[:, 1] * np.sin(headings)
    x, y = poses[-1, :2] - start[:2]
    left_m = float(y * cos - x * sin)
    turned = float(wrapped(np.diff(poses[:, 2])).sum())
    speed, end = float(np.hypot(ego[3], ego[4]) * np.sign(ego[3] or 1.0)), float(forward[-1] / period_s)
    driven = float(forward.sum())
    return Course(
        speed,
        end,
        driven / _HORIZON_S,
        float(x * cos + y * sin),
        left_m,
        turned,
        _longitudinal(speed, end),
        _lateral(driven, left_m, turned),
    )


def _longitudinal(speed: float, end: float) -> Longitudinal:
    if abs(end) < _STANDING_MPS:
        return "stop"
    gained = (end - speed) / _HORIZON_S
    if abs(gained) < _STEADY_MPS2:
        return "maintain speed"
    return "accelerate" if gained > 0 else "decelerate"


def _lateral(driven: float, left_m: float, turned: float) -> Lateral:
    if abs(turned) >= _TURN_RAD:
        return "turn left" if turned > 0 else "turn right"
    # A bend of constant curvature that turns so far ends so far to the side.
    shift = left_m - driven * turned / 2
    if abs(shift) < _LANE_SHIFT_M:
        return "keep lane"
    return "change to left lane" if shift > 0 else "change to right lane"
