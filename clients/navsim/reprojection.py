"""NAVSIM's cameras made to look like those that our models are trained with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from looktwice.clients.navsim.agent_input import Camera, InputError
from looktwice.model.driving.cameras import CameraSpec

_UNSEEN: Final = 128
"""Grey, where no camera looks."""
_MARGIN: Final = 0.25
"""How far outside a picture, as a share of it, distortion is still worked out; farther out it folds back."""

Array = npt.NDArray[np.float64]


def seen_as(spec: CameraSpec, cameras: Sequence[Camera]) -> npt.NDArray[np.uint8]:
    """What a camera like ``spec`` would show, uint8 RGB [h, w, 3], put together from ``cameras``.

    Each pixel is a direction, and is taken from the first camera that looks there; that they stand in
    slightly different places is left out of account. Directions above and below all pictures repeat the
    nearest row, as sky and road go on; what no camera sees to its sides is grey.

    Raises:
        InputError: a camera's picture or calibration is missing.
    """
    column, row = np.meshgrid(np.arange(spec.width) + 0.5, np.arange(spec.height) + 0.5)
    directions = spec.unproject(column, row, 1.0) - spec.unproject(column, row, 0.0)
    view = np.full((spec.height, spec.width, 3), _UNSEEN, np.uint8)
    unseen = np.ones((spec.height, spec.width), bool)
    for camera in cameras:
        picture, intrinsics, rotation, distortion = _calibrated(camera)
        # Shrunk first to about the view's sharpness: picking pixels out of a large picture would flicker.
        scale = min(1.0, spec.focal_px / intrinsics[0, 0])
        height, width = (max(1, round(scale * length)) for length in picture.shape[:2])
        small = np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BOX))
        to_small = np.array([width / picture.shape[1], height / picture.shape[0]])
        pixels, ahead = _project(directions @ rotation, intrinsics, distortion)
        pixels *= to_small
        seen = unseen & ahead & (pixels[..., 0] >= 0) & (pixels[..., 0] < width)
        view[seen] = _sample(small, pixels[seen])
        unseen &= ~seen
    return view


def _project(directions: Array, intrinsics: Array, distortion: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Pixels [..., 2] of directions [..., 3] in a camera's axes, and whether they are near its picture."""
    ahead = directions[..., 2] > 1e-6
    depth = np.where(ahead, directions[..., 2], 1.0)
    x, y = directions[..., 0] / depth, directions[..., 1] / depth
    # The principal point lies near the middle: twice it is about the picture's size.
    widest = (1 + 2 * _MARGIN) * intrinsics[0, 2] / intrinsics[0, 0]
    near = ahead & (np.abs(x) < widest)
    highest = (1 + 2 * _MARGIN) * intrinsics[1, 2] / intrinsics[1, 1]
    y = np.clip(y, -highest, highest)
    k1, k2, p1, p2, k3 = distortion
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    bent_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    pixels = np.stack(
        [
            intrinsics[0, 0] * bent_x + intrinsics[0, 2],
            intrinsics[1, 1] * bent_y + intrinsics[1, 2],
        ],
        axis=-1,
    )
    return pixels, near


def _sample(picture: npt.NDArray[np.uint8], pixels: Array) -> npt.NDArray[np.uint8]:
    """Colours [n, 3] at pixels [n, 2], between four neighbours; the border goes on outside."""
    height, width = picture.shape[:2]
    at = np.clip(pixels - 0.5, 0.0, [width - 1.0, height - 1.0])
    low = at.astype(int)
    high = np.minimum(low + 1, [width - 1, height - 1])
    share = (at - low)[:, :, None]
    values = picture.astype(np.float64)
    upper = values[low[:, 1], low[:, 0]] * (1 - share[:, 0]) + values[low[:, 1], high[:, 0]] * share[:, 0]
    lower = values[high[:, 1], low[:, 0]] * (1 - share[:, 0]) + values[high[:, 1], high[:, 0]] * share[:, 0]
    mixed = np.rint(upper * (1 - share[:, 1]) + lower * share[:, 1])
    return np.asarray(mixed, np.uint8)


def _calibrated(camera: Camera) -> tuple[npt.NDArray[np.uint8], Array, Array, Array]:
    if camera.image is None or camera.intrinsics is None or camera.sensor2lidar_rotation is None:
        raise InputError("a camera was not loaded: the sensor config must ask for cam_f0, cam_l0 and cam_r0")
    bent: Any = np.zeros(5) if camera.distortion is None else camera.distortion
    return (
        np.asarray(camera.image, np.uint8),
        np.asarray(camera.intrinsics, np.float64),
        np.asarray(camera.sensor2lidar_rotation, np.float64),
        np.asarray(bent, np.float64),
    )
