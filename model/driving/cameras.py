"""The cameras that our models are trained with: where they look, and how."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE


@dataclass(frozen=True)
class CameraSpec:
    """One camera: where it looks and how.

    Attributes:
        name: one of `looktwice.model.driving.scene.CAMERAS`.
        hfov_degrees: horizontal field of view.
        horizon: where the horizon lies, as a share of the picture's height from the top; the lens is
            shifted for it, not tilted, so upright things stay upright.
        heading_degrees: direction of view, counter-clockwise from straight ahead.
        forward_m, left_m, up_m: place relative to the ego's centre on the ground.
    """

    name: str
    hfov_degrees: float
    horizon: float
    heading_degrees: float = 0.0
    forward_m: float = 1.2
    left_m: float = 0.0
    up_m: float = 1.5
    width: int = 224
    height: int = 112

    def resized(self, width: int) -> CameraSpec:
        """The same camera with pictures ``width`` pixels wide, of the same shape."""
        return replace(self, width=width, height=round(width * self.height / self.width))

    @cached_property
    def focal_px(self) -> float:
        """Focal length in pixels, both directions."""
        return self.width / 2 / math.tan(math.radians(self.hfov_degrees) / 2)

    def project(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Column, row and depth [n, 3] of points [n, 3] in the ego frame; rows count downwards."""
        x, y, z = np.asarray(points, np.float64).T
        depth, left = self.depth_and_left(x, y)
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = self.column_and_row(depth, left, z)
        return np.stack([column, row, depth], axis=1)

    def column_and_row(self, depth: Any, left: Any, up: Any) -> tuple[Any, Any]:
        """Where the picture shows what lies so far along the view, to its left and above the ground."""
        column = self.width / 2 - self.focal_px * left / depth
        return column, self.horizon * self.height - self.focal_px * (up - self.up_m) / depth

    def depth_and_left(self, x: Any, y: Any) -> tuple[Any, Any]:
        """How far x and y of the ego frame lie along the view and to its left: numbers, arrays or tensors."""
        turn = math.radians(self.heading_degrees)
        x, y = x - self.forward_m, y - self.left_m
        return x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)

    def unproject(self, column: Any, row: Any, depth: Any) -> npt.NDArray[np.float64]:
        """Points [..., 3] in the ego frame seen at pixel positions with metric ``depth``."""
        up = (self.horizon * self.height - row) / self.focal_px * depth
        return np.stack([*self.from_above(column, depth), up + self.up_m], axis=-1)

    def left_of(self, column: Any, depth: Any) -> Any:
        """How far to the left of the view what a column shows at metric ``depth`` lies."""
        return (self.width / 2 - column) / self.focal_px * depth

    def from_above(self, column: Any, depth: Any) -> tuple[Any, Any]:
        """x and y in the ego frame of what a column shows at metric ``depth``: numbers, arrays or tensors."""
        left = self.left_of(column, depth)
        turn = math.radians(self.heading_degrees)
        x = depth * math.cos(turn) - left * math.sin(turn) + self.forward_m
        y = depth * math.sin(turn) + left * math.cos(turn) + self.left_m
        return x, y


FRONT_CAMERAS: Final = (
    CameraSpec(FRONT_WIDE, 120.0, 0.30),
    CameraSpec(FRONT_TELE, 30.0, 0.38),
)
SURROUND_CAMERAS: Final = (
    CameraSpec("front", 70.0, 0.35),
    CameraSpec("front_left", 70.0, 0.35, heading_degrees=55.0, left_m=0.5, forward_m=0.9),
    CameraSpec("front_right", 70.0, 0.35, heading_degrees=-55.0, left_m=-0.5, forward_m=0.9),
    CameraSpec("back", 110.0, 0.35, heading_degrees=180.0, forward_m=-1.6),
    CameraSpec("back_left", 70.0, 0.35, heading_degrees=110.0, left_m=0.5, forward_m=0.0),
    CameraSpec("back_right", 70.0, 0.35, heading_degrees=-110.0, left_m=-0.5, forward_m=0.0),
)
CAMERA_SPECS: Final = {spec.name: spec for spec in (*FRONT_CAMERAS, *SURROUND_CAMERAS)}
"""All of them by name."""
