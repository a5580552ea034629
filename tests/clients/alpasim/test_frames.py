from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from looktwice.clients.alpasim.errors import BadHistory, BadObservation, TooEarly
from looktwice.clients.alpasim.frames import FrameLog, fitted
from looktwice.model.driving.images import check_image, decode_image
from tests.service.scenes import picture

NOW_US = 10_000_000


def log(*times_us: int) -> FrameLog:
    made = FrameLog("front")
    for time_us in times_us:
        made.add(time_us, str(time_us).encode())
    return made


def times(clip: tuple[bytes, ...]) -> list[int]:
    return [int(name) for name in clip]


@pytest.mark.parametrize(
    ("period_us", "expected_s"),
    [
        (100_000, [8.5, 9.0, 9.5, 10.0]),
        (500_000, [8.5, 9.0, 9.5, 10.0]),
        (333_333, [8.333339, 9.000005, 9.333338, 10.000004]),
    ],
)
def test_a_clip_is_four_pictures_at_two_hertz(period_us: int, expected_s: list[float]) -> None:
    clip = log(*range(4 if period_us == 333_333 else 0, NOW_US + 5, period_us)).clip(NOW_US + 4)
    assert np.array(times(clip)) / 1e6 == pytest.approx(expected_s, abs=0.17)
    assert times(clip) == sorted(set(times(clip)))


def test_the_newest_picture_that_is_known_comes_last() -> None:
    frames = log(*range(0, NOW_US + 300_000, 100_000))
    assert times(frames.clip(NOW_US + 50_000))[-1] == NOW_US


@pytest.mark.parametrize("times_us", [[], [NOW_US], list(range(NOW_US - 1_400_000, NOW_US + 1, 100_000))])
def test_it_is_too_early_for_a_clip(times_us: list[int]) -> None:
    with pytest.raises(TooEarly):
        log(*times_us).clip(NOW_US)


def test_a_camera_that_has_stopped_is_no_reason_to_wait() -> None:
    with pytest.raises(BadHistory, match=r"1\.00 s old"):
        log(*range(0, NOW_US + 1, 100_000)).clip(NOW_US + 1_000_000)


def test_a_picture_is_missing_in_between() -> None:
    kept = [time_us for time_us in range(0, NOW_US + 1, 100_000) if not 8_700_000 < time_us < 9_300_000]
    with pytest.raises(BadHistory, match=r"no picture of 1\.0 s before"):
        log(*kept).clip(NOW_US)


def test_only_what_a_clip_needs_is_kept() -> None:
    assert len(log(*range(0, 100 * NOW_US, 100_000))) < 22


def test_a_picture_is_brought_to_the_models_size() -> None:
    large = io.BytesIO()
    Image.fromarray(decode_image(picture("front_wide_120", 2))).resize((1280, 720)).save(large, "JPEG")
    small = fitted(large.getvalue(), (224, 112))
    assert check_image(small) == (224, 112)
    expected = Image.fromarray(decode_image(large.getvalue())).resize((224, 112), Image.Resampling.BICUBIC)
    apart = np.abs(decode_image(small).astype(float) - np.asarray(expected, float))
    assert apart.mean() < 3.0
    assert fitted(small, (224, 112)) is small


@pytest.mark.parametrize("content", [b"", b"GIF89a", picture("front_wide_120", 0)[:1500]])
def test_what_is_no_picture_is_refused(content: bytes) -> None:
    with pytest.raises(BadObservation):
        fitted(content, (100, 50))
