"""NAVSIM's past, four poses at 2 Hz, as the model's history at 10 Hz."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.clients.navsim.agent_input import EgoStatus, InputError
from looktwice.model.driving.trajectory import HISTORY_STEPS, STEP_S, FloatArray, to_ego_frame

PERIOD_S: Final = 0.5
STATUSES: Final = 4

Array = npt.NDArray[np.float64]


def history_of(statuses: Sequence[EgoStatus]) -> FloatArray:
    """The history float32 [16, 4] in the present ego frame.

    Between two instants runs the cubic that has their poses and velocities; the heading's rate, which NAVSIM
    does not tell, is that of the neighbours. Height is zero throughout.

    Raises:
        InputError: there are not four instants.
    """
    if len(statuses) != STATUSES:
        raise InputError(f"four ego statuses at 2 Hz are needed, got {len(statuses)}")
    poses = np.array([status.ego_pose for status in statuses], np.float64)
    velocities = np.array([status.ego_velocity[:2] for status in statuses], np.float64)
    seen = to_ego_frame(np.insert(poses, 2, 0.0, axis=1), np.insert(poses[-1], 2, 0.0))
    headings = np.unwrap(seen[:, 3])
    cos, sin = np.cos(headings), np.sin(headings)
    known = np.stack([seen[:, 0], seen[:, 1], headings], axis=1)
    rates = np.stack(
        [
            cos * velocities[:, 0] - sin * velocities[:, 1],
            sin * velocities[:, 0] + cos * velocities[:, 1],
            np.gradient(headings, PERIOD_S),
        ],
        axis=1,
    )
    dense = _between(known, rates, STEP_S * np.arange(HISTORY_STEPS, dtype=np.float64))
    history = np.insert(dense, 2, 0.0, axis=1)
    history[-1] = 0.0
    return history.astype(np.float32)


def _between(values: Array, rates: Array, times_s: Array) -> Array:
    """Cubic Hermite interpolation [m, k] of values and rates [n, k] that lie `PERIOD_S` apart."""
    place = times_s / PERIOD_S
    left = np.minimum(place.astype(int), len(values) - 2)
    t = (place - left)[:, None]
    return np.asarray(
        (1 + 2 * t) * (1 - t) ** 2 * values[left]
        + t * (1 - t) ** 2 * PERIOD_S * rates[left]
        + t**2 * (3 - 2 * t) * values[left + 1]
        + t**2 * (t - 1) * PERIOD_S * rates[left + 1]
    )
