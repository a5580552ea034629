"""Encoded pictures: checked by their header first, decoded only when they are small enough."""

from __future__ import annotations

import io
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image

ALLOWED_FORMATS: Final = ("JPEG", "PNG", "WEBP")
MAX_PIXELS: Final = 4_000_000
"""About twice full HD; Pillow's own limit (89 million) would let a small file fill gigabytes."""
MAX_ENCODED_BYTES: Final = 8_000_000


class ImageError(ValueError):
    """Bytes that are not an acceptable picture; the text says why."""


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
        except (OSError, SyntaxError, ValueError) as error:
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


def _open(encoded: bytes) -> Image.Image:
    if len(encoded) > MAX_ENCODED_BYTES:
        raise ImageError(f"the picture has {len(encoded)} bytes; at most {MAX_ENCODED_BYTES} are accepted")
    try:
        image = Image.open(io.BytesIO(encoded), formats=ALLOWED_FORMATS)
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
