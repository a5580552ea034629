"""Dense targets as training takes them: coarser, and with the motion of what they show."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.facts import SPEED_SCALE_MS
from looktwice.model.driving.scene import SEMANTIC_CLASSES, DenseTarget, LabelledScene
from looktwice.model.driving.tracks import track_of
from looktwice.model.driving.trajectory import present_speed

DENSE_SHAPE: Final = (24, 48)
"""Rows and columns that dense targets are brought to."""
UNLABELLED: Final = 255
"""The class of a cell that nothing is known about."""
FIRST_AGENT_CLASS: Final = SEMANTIC_CLASSES.index("vehicle")
_REACH_M: Final = 150.0
_BOX_MARGIN_M: Final = 0.5
_BOX_MARGIN_PER_M: Final = 0.006
"""Ranges are stored to about one per cent."""


def coarse(target: DenseTarget) -> DenseTarget:
    """``target`` brought to `DENSE_SHAPE` by its nearest cells."""
    rows, columns = (
        ((np.arange(wanted) + 0.5) * there / wanted).astype(int)
        for wanted, there in zip(DENSE_SHAPE, target.classes.shape, strict=True)
    )
    cells = np.ix_(rows, columns)
    return DenseTarget(target.camera, target.classes[cells], target.range_m[cells])


def no_target(camera: str) -> DenseTarget:
    """The target of a picture that nothing is known about."""
    return DenseTarget(camera, np.full(DENSE_SHAPE, UNLABELLED, np.uint8), np.zeros(DENSE_SHAPE, np.float32))


def relative_motion(target: DenseTarget, labelled: LabelledScene) -> npt.NDArray[np.float32]:
    """How fast what each cell shows moves against the ego, float32 [2, h, w]; see `Examples.dense_motion`."""
    motion = np.zeros((2, *target.classes.shape), np.float32)
    shown = (target.classes >= FIRST_AGENT_CLASS) & (target.classes != UNLABELLED)
    if not shown.any():
        return motion
    spec = CAMERA_SPECS[target.camera]
    height, width = target.classes.shape
    row, column = np.nonzero(shown)
    points = spec.unproject(
        (column + 0.5) * spec.width / width,
        (row + 0.5) * spec.height / height,
        target.range_m[shown].astype(np.float64),
    )
    ego_speed = present_speed(labelled.scene.history)
    found = np.zeros((2, len(points)), np.float32)
    for agent in labelled.agents:
        track = track_of(agent)
        if track is None or math.hypot(track.x_m, track.y_m) > _REACH_M:
            continue
        cos, sin = math.cos(track.heading_rad), math.sin(track.heading_rad)
        dx, dy = points[:, 0] - track.x_m, points[:, 1] - track.y_m
        margin = _BOX_MARGIN_M + _BOX_MARGIN_PER_M * math.hypot(track.x_m, track.y_m)
        inside = (np.abs(dx * cos + dy * sin) < track.length_m / 2 + margin) & (
            np.abs(-dx * sin + dy * cos) < track.width_m / 2 + margin
        )
        found[0, inside] = (track.speed_ms * cos - ego_speed) / SPEED_SCALE_MS
        found[1, inside] = track.speed_ms * sin / SPEED_SCALE_MS
    motion[:, shown] = found
    return motion
