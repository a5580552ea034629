"""The latest pictures of one camera, and the clip made of them."""

from __future__ import annotations

import io
from bisect import bisect_left, bisect_right
from typing import Final

import numpy as np
from PIL import Image

from looktwice.clients.alpasim.errors import BadHistory, BadObservation, TooEarly
from looktwice.model.driving.images import ImageError, check_image, encode_jpeg
from looktwice.model.driving.scene import CLIP_FRAMES, CLIP_PERIOD_S

PERIOD_US: Final = round(CLIP_PERIOD_S * 1e6)
SPAN_US: Final = (CLIP_FRAMES - 1) * PERIOD_US
TOLERANCE_US: Final = 200_000
"""How far a picture may lie from the time that the clip asks for: cameras from 2.5 Hz on, and 2 Hz ones."""
MAX_AGE_US: Final = PERIOD_US + TOLERANCE_US
"""A camera whose newest picture is older has stopped."""
_QUALITY: Final = 95


class FrameLog:
    """Encoded pictures in order of time."""

    def __init__(self, camera: str) -> None:
        self._camera = camera
        self._times_us: list[int] = []
        self._pictures: list[bytes] = []
        self._first_us: int | None = None

    def __len__(self) -> int:
        return len(self._times_us)

    def add(self, time_us: int, picture: bytes) -> None:
        """Keep a picture; one of a time that is known already changes nothing."""
        place = bisect_left(self._times_us, time_us)
        if place < len(self._times_us) and self._times_us[place] == time_us:
            return
        self._times_us.insert(place, time_us)
        self._pictures.insert(place, picture)
        self._first_us = time_us if self._first_us is None else min(self._first_us, time_us)
        old = bisect_left(self._times_us, self._times_us[-1] - SPAN_US - 2 * TOLERANCE_US)
        del self._times_us[:old], self._pictures[:old]

    def clip(self, now_us: int) -> tuple[bytes, ...]:
        """Four pictures at 2 Hz, oldest first; the last one is the newest that ``now_us`` knows.

        Raises:
            TooEarly: the camera has not been there for 1.5 s yet.
            BadHistory: it has stopped, or pictures are missing in between.
        """
        seen = bisect_right(self._times_us, now_us)
        if not seen or self._first_us is None:
            raise TooEarly(f"no picture of camera {self._camera} yet")
        newest_us = self._times_us[seen - 1]
        if now_us - newest_us > MAX_AGE_US:
            raise BadHistory(
                f"the newest picture of camera {self._camera} is {(now_us - newest_us) / 1e6:.2f} s old"
            )
        if self._first_us > newest_us - SPAN_US:
            raise TooEarly(f"camera {self._camera} has been there for less than {SPAN_US / 1e6:.1f} s")
        times_us = np.array(self._times_us[:seen])
        chosen = []
        for back in reversed(range(CLIP_FRAMES)):
            off_us = np.abs(times_us - (newest_us - back * PERIOD_US))
            nearest = int(off_us.argmin())
            if off_us[nearest] > TOLERANCE_US:
                raise BadHistory(
                    f"camera {self._camera} has no picture of {back * CLIP_PERIOD_S:.1f} s before its newest"
                )
            chosen.append(self._pictures[nearest])
        return tuple(chosen)


def fitted(encoded: bytes, size: tuple[int, int]) -> bytes:
    """A picture in the size that the model looks at, so that planning need not shrink it four times over.

    Args:
        encoded: JPEG, PNG or WebP; returned as it is when it has that size.
        size: width and height in pixels.

    Raises:
        BadObservation: no picture, a damaged one, or one that is too large.
    """
    try:
        if check_image(encoded) == size:
            return encoded
        with Image.open(io.BytesIO(encoded)) as image:
            # JPEG alone heeds it: it is then decoded near the wanted size, many times as fast.
            image.draft("RGB", size)
            pixels = np.asarray(image.convert("RGB").resize(size, Image.Resampling.BICUBIC), np.uint8)
    except (ImageError, OSError, SyntaxError, ValueError) as error:
        raise BadObservation(f"the picture cannot be used: {error}") from error
    return encode_jpeg(pixels, _QUALITY)
