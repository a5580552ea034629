"""A route as a runtime sends it, made the model's: 20 points, one every 4 m along the way to go."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.trajectory import ROUTE_POINTS, ROUTE_SPACING_M, FloatArray

SHORTEST_M: Final = 10.0
"""A route with less left than this says nothing about the way."""

Array = npt.NDArray[np.float64]


def route_ahead(waypoints: npt.ArrayLike) -> FloatArray | None:
    """The model's route [20, 2] of waypoints [n, 2] in the ego frame; None where there is no way to go.

    It begins beside the ego; what lies behind is left out. Waypoints end at the first that is not finite,
    as alpasim fills up short routes with NaN. Past its end a route goes straight on, as in training.
    """
    points = np.asarray(waypoints, np.float64).reshape(-1, 2)
    finite = np.isfinite(points).all(axis=1)
    points = points[: len(points) if finite.all() else int(finite.argmin())]
    moved = np.ones(len(points), bool)
    moved[1:] = np.hypot(*np.diff(points, axis=0).T) > 1e-6
    points = points[moved]
    if len(points) < 2:
        return None
    begins_m, points = _beside_ego(points)
    along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    if along_m[-1] - begins_m < SHORTEST_M:
        return None
    wanted_m = begins_m + ROUTE_SPACING_M * np.arange(1, ROUTE_POINTS + 1)
    even = np.stack([np.interp(wanted_m, along_m, points[:, axis]) for axis in range(2)], axis=1)
    onward = points[-1] - points[-2]
    beyond_m = np.maximum(wanted_m - along_m[-1], 0.0)
    even += beyond_m[:, None] * onward / np.hypot(*onward)
    return even.astype(np.float32)


def _beside_ego(points: Array) -> tuple[float, Array]:
    """How far along the route the ego is; a route that begins ahead is led back to it."""
    begins, steps = points[:-1], np.diff(points, axis=0)
    lengths_m = np.hypot(*steps.T)
    share = np.clip(-(begins * steps).sum(axis=1) / lengths_m**2, 0.0, 1.0)
    nearest = int(np.hypot(*(begins + share[:, None] * steps).T).argmin())
    if nearest == 0 and share[0] == 0.0 and points[0, 0] > 0.0:
        return 0.0, np.concatenate([np.zeros((1, 2)), points])
    return float(lengths_m[:nearest].sum() + share[nearest] * lengths_m[nearest]), points
