"""Pictures of one camera as another would have taken them: cut, scaled and moved, never stretched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt
from PIL import Image

from looktwice.clients.importers.recording import Array, RecordingError
from looktwice.model.driving.cameras import CameraSpec
from looktwice.model.driving.images import ImageError, decode_image, encode_jpeg

_GREY: Final = (128, 128, 128)
_MUCH_GREY: Final = 0.1
_MUCH_STRETCHED: Final = 0.02
_MOST_APART_S: Final = 0.06
"""Between a moment and the picture that stands for it."""
JPEG_QUALITY: Final = 92

RgbImage = npt.NDArray[np.uint8]
"""A picture, RGB [height, width, 3]."""


class RecordedPictures(Protocol):
    """What one camera took, in order of time."""

    @property
    def times_s(self) -> Array:
        """[n], ascending."""

    def picture(self, number: int) -> RgbImage:
        """One of them, RGB; raises `RecordingError` where it cannot be read."""


@dataclass(frozen=True, eq=False)
class PictureFiles:
    """Pictures that are files.

    Attributes:
        times_s: [n], ascending.
        files: one a time.
    """

    times_s: Array
    files: Sequence[Path]

    def picture(self, number: int) -> RgbImage:
        """Read one of them; raises `RecordingError`."""
        file = self.files[number]
        try:
            return decode_image(file.read_bytes())
        except (OSError, ImageError) as error:
            raise RecordingError(f"{file}: {error}") from error


def nearest(pictures: RecordedPictures, moment_s: float) -> int | None:
    """The number of the picture that stands for a moment; None where there is none within 60 ms."""
    number = int(np.abs(pictures.times_s - moment_s).argmin())
    return number if abs(pictures.times_s[number] - moment_s) <= _MOST_APART_S else None


@dataclass(frozen=True)
class Source:
    """A camera that pictures come from.

    Attributes:
        name: of the camera, within the recording.
        hfov_degrees: what its pictures show from side to side.
        horizon: where the horizon lies in them, as a share of their height from the top.
        ahead: where straight ahead lies in them, as a share of their width from the left.
        vfov_degrees: what they show from top to bottom; None where pixels are square.
    """

    name: str
    hfov_degrees: float
    horizon: float = 0.5
    ahead: float = 0.5
    vfov_degrees: float | None = None

    def __post_init__(self) -> None:
        for degrees in (self.hfov_degrees, self.vfov_degrees):
            if degrees is not None and not 1 <= degrees < 170:
                raise RecordingError(f"{self.name}: a field of view of {degrees:g} degrees is none")
        if not 0 <= self.horizon <= 1:
            raise RecordingError(f"{self.name}: the horizon is a share of the height, from 0 to 1")
        if not 0 <= self.ahead <= 1:
            raise RecordingError(f"{self.name}: straight ahead is a share of the width, from 0 to 1")

    def focal_px(self, size: tuple[int, int]) -> tuple[float, float]:
        """Focal lengths across and down, in pixels of pictures of ``size`` (width, height)."""
        across_px = focal_of(size[0], self.hfov_degrees)
        return across_px, across_px if self.vfov_degrees is None else focal_of(size[1], self.vfov_degrees)


@dataclass(frozen=True, eq=False)
class OneCamera:
    """One camera that stands for another.

    Attributes:
        spec: the camera that it stands for.
        source: how it looks.
        pictures: what it took.
    """

    spec: CameraSpec
    source: Source
    pictures: RecordedPictures

    def at(self, moment_s: float) -> bytes | None:
        """Its picture as JPEG; None where nothing was taken near that moment; raises `RecordingError`."""
        number = nearest(self.pictures, moment_s)
        return None if number is None else _kept(self, number)

    def doubts(self) -> list[str]:
        """What makes its pictures unlike those of ``spec``, for people; raises `RecordingError`."""
        height, width = self.pictures.picture(0).shape[:2]
        return _doubts(self.spec, self.source, (width, height))


@lru_cache(maxsize=32)
def _kept(camera: OneCamera, number: int) -> bytes:
    """A picture as seen; scenes half a second apart share three of four."""
    return as_seen(camera.spec, camera.source, camera.pictures.picture(number))


def focal_of(extent_px: float, fov_degrees: float) -> float:
    """Focal length in pixels of a camera that shows ``fov_degrees`` over ``extent_px``."""
    return extent_px / 2 / math.tan(math.radians(fov_degrees) / 2)


def fov_of(extent_px: float, focal_px: float) -> float:
    """Field of view in degrees over ``extent_px``."""
    return 2 * math.degrees(math.atan(extent_px / 2 / focal_px))


def as_seen(spec: CameraSpec, source: Source, picture: RgbImage) -> bytes:
    """A picture as ``spec`` would have taken it, as JPEG: what it does not show is grey."""
    height, width = picture.shape[:2]
    left, top, right, bottom = _box(spec, source, (width, height))
    before_x, before_y = max(0, math.ceil(-left)), max(0, math.ceil(-top))
    size = (before_x + max(width, math.ceil(right)), before_y + max(height, math.ceil(bottom)))
    canvas = Image.new("RGB", size, _GREY)
    canvas.paste(Image.fromarray(picture), (before_x, before_y))
    box = (left + before_x, top + before_y, right + before_x, bottom + before_y)
    seen = canvas.resize((spec.width, spec.height), Image.Resampling.LANCZOS, box)
    return encode_jpeg(np.asarray(seen, np.uint8), JPEG_QUALITY)


def grey_share(spec: CameraSpec, source: Source, size: tuple[int, int]) -> float:
    """How much of what ``spec`` sees is not on pictures of that size, 0 to 1."""
    left, top, right, bottom = _box(spec, source, size)
    width = min(right, size[0]) - max(left, 0.0)
    height = min(bottom, size[1]) - max(top, 0.0)
    return 1.0 - max(0.0, width) * max(0.0, height) / ((right - left) * (bottom - top))


def _doubts(spec: CameraSpec, source: Source, size: tuple[int, int]) -> list[str]:
    told = []
    grey = grey_share(spec, source, size)
    if grey > _MUCH_GREY:
        told.append(
            f"{spec.name} sees {spec.hfov_degrees:g} degrees, the pictures of {source.name} "
            f"{source.hfov_degrees:.3g}: {grey:.0%} of what the model gets is grey"
        )
    across_px, down_px = source.focal_px(size)
    if abs(down_px / across_px - 1) > _MUCH_STRETCHED:
        way = "tall" if down_px > across_px else "wide"
        by = max(down_px / across_px, across_px / down_px) - 1
        told.append(
            f"the pictures of {source.name} are stretched, {by:.0%} too {way}; the model gets them even"
        )
    return told


def _box(spec: CameraSpec, source: Source, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of what ``spec`` sees, in pixels of pictures of that size."""
    width, height = size
    across_px, down_px = source.focal_px(size)
    scale_x, scale_y = across_px / spec.focal_px, down_px / spec.focal_px
    left = source.ahead * width - scale_x * spec.width / 2
    top = source.horizon * height - scale_y * spec.horizon * spec.height
    return left, top, left + scale_x * spec.width, top + scale_y * spec.height
