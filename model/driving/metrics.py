"""Open-loop measures of trajectories (CF-VLA section 4.1), vectorised over draws.

Draws are float32 [n, t, 4] and the expert is float32 [t, 4], at the same times; distances in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, Agent
from looktwice.model.driving.trajectory import STEP_S, TEN_HZ_S, FloatArray, at_times, shared_times

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

COLLISION_WITHIN_S: Final = 5.0
"""CF-VLA counts collisions within the first five seconds."""

_CORNER_SIGNS: Final = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=np.float64)


@dataclass(frozen=True)
class DisplacementErrors:
    """Displacement errors over the draws of one scene, metres."""

    min_ade_m: float
    avg_ade_m: float
    min_fde_m: float
    avg_fde_m: float
    corner_distance_m: float


def displacement_errors(draws: FloatArray, expert: FloatArray) -> DisplacementErrors:
    """All displacement measures of draws [n, t, 4] against the expert [t, 4], see `common`.

    Minima are taken apart: the draw of the smallest ADE need not have the smallest FDE. The corner
    distance is the smallest over the draws, as minADE is.
    """
    distance = np.linalg.norm(draws[..., :2].astype(np.float64) - expert[..., :2].astype(np.float64), axis=-1)
    ade, fde = distance.mean(axis=-1), distance[..., -1]
    return DisplacementErrors(
        min_ade_m=float(ade.min()),
        avg_ade_m=float(ade.mean()),
        min_fde_m=float(fde.min()),
        avg_fde_m=float(fde.mean()),
        corner_distance_m=float(corner_distances(draws, expert).min()),
    )


def common(
    draws: FloatArray, expert: FloatArray, times_s: Sequence[float] = TEN_HZ_S
) -> tuple[FloatArray, FloatArray]:
    """Draws [n, t, 4] with poses at ``times_s`` and the expert [64, 4], both at the draws' times.

    What lies behind the expert's 6.4 s is left out.
    """
    times_s = shared_times(TEN_HZ_S, times_s)
    return draws[:, : len(times_s)], at_times(expert, TEN_HZ_S, times_s)


def box_corners(poses: npt.NDArray[np.floating], length_m: float, width_m: float) -> Array:
    """Corners [..., 4, 2] of boxes centred at poses [..., 3] (x, y, heading), in one sense of turning."""
    centre = np.asarray(poses[..., :2], dtype=np.float64)
    heading = np.asarray(poses[..., 2], dtype=np.float64)
    half = _CORNER_SIGNS * np.array([length_m, width_m]) / 2
    cos, sin = np.cos(heading)[..., None], np.sin(heading)[..., None]
    return np.stack(
        [
            centre[..., None, 0] + cos * half[:, 0] - sin * half[:, 1],
            centre[..., None, 1] + sin * half[:, 0] + cos * half[:, 1],
        ],
        axis=-1,
    )


def ego_corners(trajectories: npt.NDArray[np.floating]) -> Array:
    """Corners [..., 4, 2] of the ego's box along trajectories [..., 4]."""
    return box_corners(trajectories[..., [0, 1, 3]], EGO_LENGTH_M, EGO_WIDTH_M)


def corner_distances(draws: FloatArray, expert: FloatArray) -> Array:
    """Mean distance [n] between matching corners of the ego's box, draw against expert."""
    apart = np.linalg.norm(ego_corners(draws) - ego_corners(expert), axis=-1)
    result: Array = apart.mean(axis=(-1, -2))
    return result


def collides(
    trajectories: FloatArray, agents: Sequence[Agent], within_s: float = COLLISION_WITHIN_S
) -> BoolArray:
    """Whether each of the trajectories [n, t, 4] meets another agent's box within ``within_s`` seconds.

    Boxes are oriented rectangles at equal times (10 Hz), tested by separating axes.
    """
    steps = min(round(within_s / STEP_S), trajectories.shape[1])
    hit = np.zeros(len(trajectories), dtype=np.bool_)
    ego = ego_corners(trajectories[:, :steps])
    ego_axes = _axes(np.asarray(trajectories[:, :steps, 3], dtype=np.float64))
    reach_m = np.hypot(EGO_LENGTH_M, EGO_WIDTH_M) / 2
    for agent in agents:
        future = agent.future[:steps]
        apart = np.hypot(trajectories[:, :steps, 0] - future[:, 0], trajectories[:, :steps, 1] - future[:, 1])
        near = apart <= reach_m + np.hypot(agent.length_m, agent.width_m) / 2  # False where absent (NaN)
        rows, times = np.nonzero(near & ~hit[:, None])
        if len(rows) == 0:
            continue
        box = box_corners(future, agent.length_m, agent.width_m)[times]
        axes = np.concatenate(
            [ego_axes[rows, times], _axes(np.asarray(future[:, 2], dtype=np.float64))[times]], axis=1
        )
        ego_span = np.einsum("kcd,kad->kac", ego[rows, times], axes)
        box_span = np.einsum("kcd,kad->kac", box, axes)
        overlap = (ego_span.min(-1) <= box_span.max(-1)) & (box_span.min(-1) <= ego_span.max(-1))
        hit[rows[overlap.all(axis=1)]] = True
    return hit


def leaves_road(trajectories: FloatArray, drivable: Sequence[FloatArray]) -> BoolArray:
    """Whether a corner of the ego's box ever leaves the drivable area, for trajectories [n, t, 4].

    ``drivable`` are closed rings; a point is inside when an odd number of rings contains it.
    """
    corners = ego_corners(trajectories)
    inside = points_inside(corners.reshape(-1, 2), drivable).reshape(corners.shape[:-1])
    return np.asarray(~inside.all(axis=(-1, -2)), dtype=np.bool_)


def points_inside(points: npt.NDArray[np.floating], rings: Sequence[FloatArray]) -> BoolArray:
    """Even-odd test of points [k, 2] against closed rings."""
    x, y = np.asarray(points[:, 0], np.float64), np.asarray(points[:, 1], np.float64)
    crossings = np.zeros(len(x), dtype=np.int64)
    for ring in rings:
        start = np.asarray(ring, np.float64)
        end = np.roll(start, -1, axis=0)
        # Few edges cross the horizontal line through a point; only for those does it matter where.
        point, edge = np.nonzero((start[:, 1] > y[:, None]) != (end[:, 1] > y[:, None]))
        slope = (end[edge, 0] - start[edge, 0]) / (end[edge, 1] - start[edge, 1])
        crossing_x = start[edge, 0] + (y[point] - start[edge, 1]) * slope
        crossings += np.bincount(point[x[point] < crossing_x], minlength=len(x))
    return np.asarray(crossings % 2 == 1, dtype=np.bool_)


def _axes(heading: Array) -> Array:
    """The two unit axes [..., 2, 2] of boxes with headings [...]."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], axis=-2)
