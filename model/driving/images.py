"""Encoded pictures: checked by their header first, decoded only when they are small enough."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image

ALLOWED_FORMATS: Final = ("JPEG", "PNG", "WEBP")
MAX_PIXELS: Final = 4_000_000
"""About twice full HD; Pillow's own limit (89 million) would let a small file fill gigabytes."""
MAX_ENCODED_BYTES: Final = 8_000_000
MAX_SCANS: Final = 32
"""Of a progressive JPEG: encoders write about ten, and each makes the decoder go over all pixels again."""
MAX_FRAMES: Final = 64
"""Of an animated WebP, whose first frame alone is shown: all of them are looked for when it is opened."""
_JPEG, _SCAN, _RIFF, _FRAME = b"\xff\xd8", b"\xff\xda", b"RIFF", b"ANMF"
MAX_READS: Final = 10_000
"""That a decoder may make: one for 64 kB of pixels, three for a chunk of a PNG, which is some kB."""
MAX_DECODE_CPU_S: Final = 1.0
"""Five times what the dearest picture within the other bounds takes. Time of the thread itself, so that a
busy neighbour refuses nobody."""


class ImageError(ValueError):
    """Bytes that are not an acceptable picture; the text says why."""


_wanted: ContextVar[Callable[[], bool]] = ContextVar("_wanted", default=lambda: True)


@contextmanager
def decoding_while(wanted: Callable[[], bool]) -> Generator[None]:
    """Within the block, pictures end with an `ImageError` at their next read once they are not ``wanted``."""
    token = _wanted.set(wanted)
    try:
        yield
    finally:
        _wanted.reset(token)


class _GuardedBytes(io.BytesIO):
    """Bytes that can be read so many times, while they are wanted, and no longer than a picture may take."""

    def __init__(self, encoded: bytes) -> None:
        super().__init__(encoded)
        self._reads, self._ends_s = 0, time.thread_time() + MAX_DECODE_CPU_S
        self._wanted = _wanted.get()

    def read(self, size: int | None = -1, /) -> bytes:
        if not self._wanted():
            raise ImageError("nobody waits for the picture any more")
        self._reads += 1
        if self._reads > MAX_READS:
            raise ImageError("the picture is in too many pieces")
        if not self._reads % 64 and time.thread_time() > self._ends_s:
            raise ImageError("the picture takes too long to decode")
        return super().read(size)


def check_image(encoded: bytes) -> tuple[int, int]:
    """Width and height read from the header, without decoding a pixel.

    Raises:
        ImageError: not JPEG, PNG or WebP; more than `MAX_PIXELS`; more than `MAX_ENCODED_BYTES`.
    """
    with _open(encoded) as image:
        return image.size


def media_type(encoded: bytes) -> str:
    """``image/jpeg`` and the like; raises `ImageError` as `check_image` does."""
    with _open(encoded) as image:
        return Image.MIME[str(image.format)]


def decode_image(encoded: bytes) -> npt.NDArray[np.uint8]:
    """The picture as uint8 RGB [h, w, 3]; raises `ImageError` as `check_image` does, or when damaged."""
    with _open(encoded) as image:
        try:
            return np.asarray(image.convert("RGB"), dtype=np.uint8)
        except (ImageError, MemoryError):
            raise
        except Exception as error:  # whatever a reader ends with, such as an IndexError behind the pixels
            raise ImageError(f"the picture is damaged: {error}") from error


def encode_jpeg(pixels: npt.NDArray[np.uint8], quality: int = 85) -> bytes:
    """uint8 RGB [h, w, 3] as JPEG bytes."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def encode_png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """uint8 RGB [h, w, 3] or grey [h, w] as PNG bytes."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def tiled(rows: Sequence[Sequence[npt.NDArray[np.uint8]]], gap: int = 4) -> npt.NDArray[np.uint8]:
    """Pictures uint8 [h, w, 3] of one size in rows, white between them; the last row may be shorter."""
    height, width, _ = rows[0][0].shape
    across, down = width + gap, height + gap
    sheet = np.full((len(rows) * down - gap, len(rows[0]) * across - gap, 3), 255, np.uint8)
    for row, pictures in enumerate(rows):
        for column, picture in enumerate(pictures):
            y, x = row * down, column * across
            sheet[y : y + height, x : x + width] = picture
    return sheet


def _open(encoded: bytes) -> Image.Image:
    if len(encoded) > MAX_ENCODED_BYTES:
        raise ImageError(f"the picture has {len(encoded)} bytes; at most {MAX_ENCODED_BYTES} are accepted")
    # Either may stand in data that says nothing of scans or frames, so these are upper bounds.
    if encoded.startswith(_JPEG) and encoded.count(_SCAN) > MAX_SCANS:
        raise ImageError(f"the picture has more than {MAX_SCANS} scans; save it again, without so many")
    if encoded.startswith(_RIFF) and encoded.count(_FRAME) > MAX_FRAMES:
        raise ImageError(f"the picture has more than {MAX_FRAMES} frames; send one")
    try:
        image = Image.open(_GuardedBytes(encoded), formats=ALLOWED_FORMATS)
    except ImageError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        # Pillow warns from 89 million pixels on (an error under -W error) and refuses from twice that on.
        raise ImageError(f"the picture is too large: {error}") from error
    except (OSError, SyntaxError, ValueError) as error:
        raise ImageError(f"not a {', '.join(ALLOWED_FORMATS)} picture") from error
    width, height = image.size
    if width * height > MAX_PIXELS:
        image.close()
        raise ImageError(f"the picture is {width}x{height}; at most {MAX_PIXELS} pixels are accepted")
    return image
