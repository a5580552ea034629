"""Pictures to flattened patches, laid out as Qwen2.5-VL's video processor lays them out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from looktwice.model.network.vla_settings import VlaSettings

PIXEL_MEAN: Final = (0.48145466, 0.4578275, 0.40821073)
PIXEL_STD: Final = (0.26862954, 0.26130258, 0.27577711)
"""Of RGB in 0..1; Qwen2.5-VL took them over from CLIP (transformers, `OPENAI_CLIP_MEAN`)."""

PATCH_ORDER: Final = (0, 2, 5, 3, 6, 8, 1, 4, 7)
"""Of the axes of a `patch_grid`: slice, row, column, then places within what is merged, then in a patch."""


def resize(picture: npt.NDArray[np.uint8], settings: VlaSettings) -> npt.NDArray[np.uint8]:
    """uint8 RGB [h, w, 3] brought to the checkpoint's picture size; unchanged when it has that size."""
    size = (settings.image_width, settings.image_height)
    if picture.shape[1::-1] == size:
        return picture
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC), np.uint8)


def patchify(frames: npt.NDArray[np.uint8], settings: VlaSettings) -> npt.NDArray[np.uint8]:
    """Patches uint8 [p, 3 x temporal x patch x patch] of frames [f, h, w, 3], still without normalisation.

    Frames are those of one or more clips in a row; p = f / temporal x h / patch x w / patch. Patches that
    will be merged lie side by side; within one the order is channel, time, row, column.
    """
    parts = frames.reshape(patch_grid(frames.shape, settings))
    return parts.transpose(PATCH_ORDER).reshape(-1, patch_width(settings))


def patch_grid(shape: Sequence[int], settings: VlaSettings) -> tuple[int, ...]:
    """How frames of ``shape`` [f, h, w, 3] are cut: slice, time, row, merge, y, column, merge, x, channel."""
    time, patch, merge = settings.temporal_patch_size, settings.patch_size, settings.spatial_merge_size
    count, height, width, channels = shape
    rows, columns = height // (patch * merge), width // (patch * merge)
    return (count // time, time, rows, merge, patch, columns, merge, patch, channels)


def patch_width(settings: VlaSettings) -> int:
    """Values in a patch."""
    return 3 * settings.temporal_patch_size * settings.patch_size**2


def normalise(patches: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """uint8 patches [p, n] as the float32 patches that `transformers` calls ``pixel_values_videos``."""
    scale, shift = normalisation(patches.shape[1])
    return patches * scale + shift


def normalisation(width: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Scale and shift float32 [width] that normalise a uint8 patch row of ``width`` values."""
    std, mean = np.array(PIXEL_STD), np.array(PIXEL_MEAN)
    repeat = width // 3
    return (
        np.repeat(1 / (255 * std), repeat).astype(np.float32),
        np.repeat(-mean / std, repeat).astype(np.float32),
    )
