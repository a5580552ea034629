"""What a camera will see once the ego has moved, if nothing else moves: a flat road, and a wall far away."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.cameras import CAMERA_SPECS, CameraSpec
from looktwice.model.driving.short_term import AHEAD_S, INERTIA
from looktwice.model.driving.trajectory import (
    STEP_S,
    TEN_HZ_S,
    FloatArray,
    GeometryError,
    at_times,
    check_times,
    check_trajectory,
    shared_times,
    to_ego_frame,
)

Array = npt.NDArray[np.float64]

FAR_M: Final = 40.0
"""How far away everything is that is no road. Of 20, 40, 80 m and never, this one came nearest to what six
rendered cameras saw half a second later."""


MOST_M: Final = 40.0
"""Farther nobody comes in half a second."""


@dataclass(frozen=True)
class Motion:
    """Where the ego will be in half a second, in its frame of now.

    Raises:
        GeometryError: a number is not finite, or the ego would be farther away than `MOST_M`.
    """

    x_m: float
    y_m: float
    heading_rad: float

    def __post_init__(self) -> None:
        away_m = math.hypot(self.x_m, self.y_m)
        if not (math.isfinite(self.heading_rad) and away_m <= MOST_M):
            raise GeometryError(
                f"nobody comes to ({self.x_m}, {self.y_m}) m with a heading of {self.heading_rad} in half a "
                f"second; {MOST_M:g} m are the most"
            )


def motion_along(trajectory: npt.ArrayLike, times_s: Sequence[float] = TEN_HZ_S) -> Motion:
    """Where an ego that drives a trajectory will be in half a second; between two poses on a straight line.

    Args:
        trajectory: [64, 4], or [t, 4] with poses at ``times_s``, in the ego frame.

    Raises:
        GeometryError: no trajectory, or none of these times; one that begins later than in half a second or
            ends before; or a `Motion` that nobody makes.
    """
    check_times(times_s)
    poses = check_trajectory(trajectory, times_s)
    if not (shared_times((AHEAD_S,), times_s[:1]) and shared_times(times_s, (AHEAD_S,))):
        raise GeometryError(
            f"half a second is beyond the horizon of a trajectory from {times_s[0]:g} s to {times_s[-1]:g} s"
        )
    x_m, y_m, _, heading_rad = at_times(poses, times_s, (AHEAD_S,))[0].tolist()
    return Motion(x_m, y_m, heading_rad)


def expected_view(
    frame: npt.NDArray[np.uint8], camera: str, history: FloatArray, motion: Motion | None = None
) -> npt.NDArray[np.uint8]:
    """`expected_views` of what a camera sees now alone: uint8 [h, w, 3]."""
    view: npt.NDArray[np.uint8] = expected_views((frame,), camera, history, motion)[0]
    return view


def expected_views(
    frames: Sequence[npt.NDArray[np.uint8]], camera: str, history: FloatArray, motion: Motion | None = None
) -> npt.NDArray[np.uint8]:
    """What a camera would see in half a second if only the ego moved, as each of some pictures tells it.

    Where two of them differ, something moved, or is no flat road.

    Args:
        frames: uint8 [h, w, 3] each, half a second apart, the last one of now; at most four.
        camera: one of `CAMERAS`; taken for one that our models are trained with.
        history: float32 [16, 4] of the ego.
        motion: of the ego; without one it keeps its momentum.

    Returns:
        uint8 [frames, h, w, 3].
    """
    x_m, y_m, heading_rad = INERTIA.ego(history, None) if motion is None else astuple(motion)
    taken_from = history[:: -round(AHEAD_S / STEP_S)][: len(frames)][::-1]
    return np.stack(
        [
            moved_view(frame, CAMERA_SPECS[camera], to_ego_frame((x_m, y_m, 0, heading_rad), pose)[[0, 1, 3]])
            for frame, pose in zip(frames, taken_from, strict=True)
        ]
    )


def moved_view(
    frame: npt.NDArray[np.uint8], camera: CameraSpec, pose: npt.ArrayLike
) -> npt.NDArray[np.uint8]:
    """A picture as it would look from another pose.

    A pixel below the horizon shows a flat road, up to `FAR_M`; all others a wall there. What is not in view
    now stays as ``frame`` has it.

    Args:
        frame: uint8 [h, w, 3], what the camera sees now.
        camera: how it looks; of any size, but of the picture's shape.
        pose: [3] of the ego then, in its frame of now: metres ahead, metres to the left, heading.
    """
    height, width = frame.shape[:2]
    columns, rows = _now(camera.resized(width), np.asarray(pose, np.float64))
    # A pixel's middle: places from 0.0 to 1.0 are the first one.
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    moved = frame.copy()
    moved[inside] = frame[rows[inside].astype(np.intp), columns[inside].astype(np.intp)]
    return moved


def _now(camera: CameraSpec, pose: Array) -> tuple[Array, Array]:
    """Columns and rows [h, w] at which the camera sees now what each pixel shows then; -1 for nowhere."""
    rows, columns = np.indices((camera.height, camera.width)) + 0.5
    below = np.maximum(rows - camera.horizon * camera.height, 1e-9)
    depth_m = np.minimum(camera.focal_px * camera.up_m / below, FAR_M)
    points = camera.unproject(columns, rows, depth_m).reshape(-1, 3)
    x_m, y_m, heading = pose.tolist()
    cos, sin = math.cos(heading), math.sin(heading)
    turned = points[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    points[:, :2] = turned + np.array([x_m, y_m])
    column, row, depth = camera.project(points).T
    behind = depth <= 0
    column[behind] = row[behind] = -1
    return column.reshape(rows.shape), row.reshape(rows.shape)
