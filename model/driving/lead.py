"""Whether a vehicle ahead is in the ego's way."""

from __future__ import annotations

from typing import Final

import numpy as np

from looktwice.model.driving.scene import EGO_LENGTH_M, LabelledScene
from looktwice.model.driving.trajectory import FloatArray

LEAD_WITHIN_M: Final = 20.0
LANE_HALF_WIDTH_M: Final = 1.75
"""Half of MetaDrive's 3.5 m lanes: what is closer than this to the ego's path is in its way."""


def lead_within(labelled: LabelledScene, metres: float = LEAD_WITHIN_M) -> bool:
    """Whether a vehicle's centre is now in the ego's way, up to ``metres`` ahead of the front bumper.

    In the way is what is closer than half a lane to the line straight ahead or to the expert's path, which
    is prolonged along its last heading, for an expert that stops behind the vehicle.
    """
    future = labelled.future.astype(np.float64)
    reach_m = EGO_LENGTH_M / 2 + metres
    beyond = np.linspace(1.0, reach_m, 64)[:, None]
    last = future[-1]
    path = np.concatenate(
        [
            np.zeros((1, 2)),
            future[:, :2],
            last[:2] + beyond * np.array([np.cos(last[3]), np.sin(last[3])]),
        ]
    )
    for agent in labelled.agents:
        x, y = (float(value) for value in agent.present[:2])
        if agent.kind != "vehicle" or not EGO_LENGTH_M / 2 < x <= reach_m:  # False where absent (NaN)
            continue
        if min(abs(y), _distance_to_line(np.array([x, y]), path)) < LANE_HALF_WIDTH_M:
            return True
    return False


def _distance_to_line(point: FloatArray, line: FloatArray) -> float:
    """Distance of a point [2] to a polyline [k, 2]."""
    start, step = line[:-1], np.diff(line, axis=0)
    length_sq = np.maximum((step**2).sum(axis=1), 1e-12)
    along = np.clip(((point - start) * step).sum(axis=1) / length_sq, 0, 1)
    return float(np.linalg.norm(start + along[:, None] * step - point, axis=1).min())
