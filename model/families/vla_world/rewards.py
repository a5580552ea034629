"""What a response of VLA-World is worth beside what the expert did (section 3.5), part by part from 0 to 1.

The paper says what each part is for, and neither its scale nor its weight: the scales are chosen here. Two of
its five parts are missing. The form of a response and the number of its picture's codes are always right,
since nothing else can be written.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.trajectory import TEN_HZ_S, FloatArray, at_times
from looktwice.model.families.family import FamilyError, Reading
from looktwice.model.families.vla_world.actions import action_of, counted
from looktwice.model.families.vla_world.format import TIMES_S

OFF_MS: Final = 2.0
"""A point is worth nothing that is off by as much as this speed comes to by its time."""
UNSTEADY_MS2: Final = 4.0
"""So are waypoints whose acceleration changes by so much more than the expert's, from one to the next."""
STEADY_SHARE: Final = 0.25
"""Of the waypoints' reward; the rest is how near they are."""

PREDICTION: Final = "prediction"
ACTION: Final = "action"
WAYPOINTS: Final = "waypoints"
REWARDS: Final = (PREDICTION, ACTION, WAYPOINTS)


def rewards(future: FloatArray, reading: Reading) -> Mapping[str, float]:
    """What a response is worth, by part.

    Args:
        future: float32 [64, 4], the expert's trajectory at 10 Hz.
        reading: what the response says.

    Raises:
        FamilyError: it foresees nothing: no response of VLA-World says that.
    """
    if reading.foreseen is None:
        raise FamilyError("nothing is foreseen: VLA-World's rewards are for its own responses")
    expert, told = at_times(future, TEN_HZ_S, TIMES_S)[:, :2], reading.trajectory[:, :2]
    action = action_of(expert)
    soon = [[reading.foreseen.x_m, reading.foreseen.y_m]]
    said, done = reading.action, counted(action)
    prediction = (
        _near(soon, expert[:1]),
        _near(soon, told[:1]),
        float(reading.foreseen.direction == action.direction),
    )
    unsteady = max(0.0, _unsteady_ms2(told) - _unsteady_ms2(expert))
    return {
        PREDICTION: float(np.mean(prediction)),
        # F1 of two sets of words, one of each group: as many are right as are missing.
        ACTION: float(np.mean([mine == right for mine, right in zip(said, done, strict=True)])),
        WAYPOINTS: (1 - STEADY_SHARE) * _near(told, expert)
        + STEADY_SHARE * max(0.0, 1 - unsteady / UNSTEADY_MS2),
    }


def _near(points: npt.ArrayLike, others: FloatArray) -> float:
    """How near points [k, 2] at the first k times are to others, 0 to 1."""
    off_ms = np.linalg.norm(np.asarray(points) - others, axis=1) / TIMES_S[: len(others)]
    return float(np.maximum(0, 1 - off_ms / OFF_MS).mean())


def _unsteady_ms2(waypoints: FloatArray) -> float:
    """Mean change of acceleration from one half second to the next."""
    speeds_ms = np.diff(np.concatenate([np.zeros((1, 2)), waypoints]), axis=0) / TIMES_S[0]
    return float(np.linalg.norm(np.diff(speeds_ms, n=2, axis=0) / TIMES_S[0], axis=1).mean())
