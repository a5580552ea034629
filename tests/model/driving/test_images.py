from __future__ import annotations

import contextlib
import io
import struct
import time
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from looktwice.model.driving import images
from looktwice.model.driving.images import (
    MAX_ENCODED_BYTES,
    MAX_FRAMES,
    MAX_SCANS,
    ImageError,
    check_image,
    decode_image,
    encode_jpeg,
    encode_png,
)

PIXELS = np.random.default_rng(1).integers(0, 256, (12, 20, 3), dtype=np.uint8)


def saved(kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(PIXELS).save(buffer, kind)
    return buffer.getvalue()


def png_with_header(width: int, height: int) -> bytes:
    """A PNG of a few bytes whose header claims any size."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(b"\0" * 100)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_accepted_kinds_are_measured_and_decoded(kind: str) -> None:
    assert check_image(saved(kind)) == (20, 12)
    pixels = decode_image(saved(kind))
    assert pixels.shape == (12, 20, 3)
    assert pixels.dtype == np.uint8


def test_png_keeps_every_pixel_and_jpeg_nearly() -> None:
    np.testing.assert_array_equal(decode_image(encode_png(PIXELS)), PIXELS)
    smooth = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    assert np.abs(decode_image(encode_jpeg(smooth)).astype(int) - smooth).max() <= 3


def test_grey_pictures_become_rgb() -> None:
    np.testing.assert_array_equal(decode_image(encode_png(PIXELS[..., 0]))[..., 1], PIXELS[..., 0])


@pytest.mark.parametrize(
    ("width", "height"),
    [(40_000, 40_000), (12_000, 8_000), (2_001, 2_000)],  # Pillow refuses, warns, says nothing
)
def test_a_bomb_is_refused_by_its_header(width: int, height: int) -> None:
    with pytest.raises(ImageError, match=r"too large|at most 4000000 pixels"):
        check_image(png_with_header(width, height))


def test_the_largest_size_is_accepted_by_its_header() -> None:
    assert check_image(png_with_header(2_000, 2_000)) == (2_000, 2_000)


@pytest.mark.parametrize("encoded", [b"", b"hello", saved("GIF"), saved("BMP"), saved("TIFF")])
def test_other_bytes_are_no_picture(encoded: bytes) -> None:
    with pytest.raises(ImageError, match="not a JPEG, PNG, WEBP picture"):
        check_image(encoded)


def test_too_many_bytes_are_refused_unread() -> None:
    with pytest.raises(ImageError, match="bytes; at most"):
        check_image(saved("PNG") + b"\0" * MAX_ENCODED_BYTES)


def test_a_truncated_jpeg_passes_the_header_check_and_fails_to_decode() -> None:
    half = saved("JPEG")[:-100]
    assert check_image(half) == (20, 12)
    with pytest.raises(ImageError, match="damaged"):
        decode_image(half)


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from(["JPEG", "PNG", "WEBP"]),
    st.lists(st.tuples(st.integers(0, 700), st.integers(0, 255)), min_size=1, max_size=20),
)
def test_damaged_bytes_are_decoded_or_refused_and_nothing_else(
    kind: str, changes: list[tuple[int, int]]
) -> None:
    encoded = bytearray(saved(kind))
    for place, value in changes:
        encoded[place % len(encoded)] = value
    with contextlib.suppress(ImageError):
        assert decode_image(bytes(encoded)).ndim == 3


def test_a_damaged_chunk_behind_the_pixels_is_refused() -> None:
    png = saved("PNG")
    end = png.index(b"IEND") - 4
    with pytest.raises(ImageError, match="damaged"):
        decode_image(png[:end] + chunk(b"iCCP") + png[end:])


def progressive(scans: int) -> bytes:
    """A progressive JPEG whose last scan comes so many times more."""
    buffer = io.BytesIO()
    Image.fromarray(PIXELS).save(buffer, "JPEG", progressive=True, quality=70)
    encoded = buffer.getvalue()
    begins = encoded.rfind(b"\xff\xda")
    return encoded[:-2] + encoded[begins:-2] * scans + encoded[-2:]


def chunk(kind: bytes, body: bytes = b"") -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def animated(frames: int) -> bytes:
    buffer = io.BytesIO()
    numbers = np.random.default_rng(2)
    first, *others = (
        Image.fromarray(numbers.integers(0, 256, (8, 8, 3), dtype=np.uint8)) for _ in range(frames)
    )
    first.save(buffer, "WEBP", save_all=True, append_images=others, lossless=True)
    return buffer.getvalue()


def test_pictures_as_encoders_write_them_are_decoded() -> None:
    assert decode_image(progressive(0)).shape == (12, 20, 3)
    assert decode_image(progressive(MAX_SCANS - 12)).shape == (12, 20, 3)
    assert decode_image(animated(3)).shape == (8, 8, 3)


JPEG, PNG = progressive(0), encode_png(PIXELS)


@pytest.mark.parametrize(
    ("encoded", "message"),
    [
        (progressive(3000), "scans"),
        (animated(MAX_FRAMES + 8), "frames"),
        (PNG[:33] + chunk(b"teSt") * 600_000 + PNG[33:], "pieces"),
        (PNG[:33] + chunk(b"IDAT") * 600_000 + PNG[33:], "pieces"),
        (JPEG[:2] + b"\xff\xe1\x00\x02" * 1_900_000 + JPEG[2:], "pieces"),
        (JPEG[:2] + b"\xff" * 7_500_000 + JPEG[2:], "pieces"),
    ],
    ids=["scans", "frames", "chunks", "empty data", "segments", "fill bytes"],
)
def test_small_pictures_that_are_dear_to_decode_are_refused(encoded: bytes, message: str) -> None:
    began_s = time.thread_time()
    with pytest.raises(ImageError, match=message):
        decode_image(encoded)
    # Seconds before; of the thread's own time, so that a busy machine does not matter.
    assert time.thread_time() - began_s < 1.0


def test_decoding_has_a_budget_of_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "MAX_DECODE_CPU_S", -1.0)
    many = PNG[:33] + chunk(b"teSt") * 200 + PNG[33:]
    with pytest.raises(ImageError, match="too long"):
        decode_image(many)
