from __future__ import annotations

import math

import numpy as np
import pytest

from looktwice.clients.alpasim.egomotion import EgoLog, Observed
from looktwice.clients.alpasim.errors import BadHistory, TooEarly

NOW_US = 1_700_000_000_000_000
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def arc(time_us: int, speed_mps: float = 8.0, yaw_rate: float = 0.3) -> Observed:
    """Where a car is that turns left around a point, far away from the origin of its world."""
    heading = yaw_rate * (time_us - NOW_US) / 1e6 + 3.0
    radius_m = speed_mps / yaw_rate
    place = (4e5 + radius_m * math.sin(heading), -2e5 - radius_m * math.cos(heading), 12.0)
    wrapped = (heading + math.pi) % (2 * math.pi) - math.pi
    return Observed((*place, wrapped), UPRIGHT)


def log(*times_us: int) -> EgoLog:
    made = EgoLog()
    for time_us in times_us:
        made.add(time_us, arc(time_us))
    return made


def at_10_hz(offset_us: int = 0, count: int = 20) -> list[int]:
    return [NOW_US + offset_us - 100_000 * back for back in reversed(range(count))]


@pytest.mark.parametrize("offset_us", [0, 37_000])
def test_the_history_is_the_past_seen_from_now(offset_us: int) -> None:
    history = log(*at_10_hz(offset_us)).history(NOW_US)
    assert history.shape == (16, 4)
    assert not history[-1].any()
    seconds = 0.1 * np.arange(-15, 1)
    radius_m = 8.0 / 0.3
    np.testing.assert_allclose(history[:, 0], radius_m * np.sin(0.3 * seconds), atol=6e-3)
    np.testing.assert_allclose(history[:, 1], radius_m * (1 - np.cos(0.3 * seconds)), atol=6e-3)
    # Headings pass pi on the way; seen from the ego they do not jump.
    np.testing.assert_allclose(history[:, 3], 0.3 * seconds, atol=1e-4)


def test_poses_may_come_in_any_order_and_twice() -> None:
    times_us = at_10_hz()
    shuffled = log(*times_us[::2], *times_us[1::2])
    shuffled.add(times_us[-1], Observed((0.0, 0.0, 0.0, 0.0), UPRIGHT))
    np.testing.assert_array_equal(shuffled.history(NOW_US), log(*times_us).history(NOW_US))


def test_old_poses_are_forgotten() -> None:
    assert len(log(*at_10_hz(count=200))) == 31


def test_there_is_no_pose_yet() -> None:
    with pytest.raises(TooEarly):
        EgoLog().history(NOW_US)


@pytest.mark.parametrize(
    ("times_us", "message"),
    [
        (at_10_hz(count=15), "poses cover 1.40 s"),
        (at_10_hz(offset_us=-300_000), "the newest pose is 0.30 s old"),
        (at_10_hz()[:8] + at_10_hz()[-4:], "a gap of 0.90 s"),
    ],
)
def test_a_bad_history_says_what_is_wrong(times_us: list[int], message: str) -> None:
    with pytest.raises(BadHistory, match=message):
        log(*times_us).history(NOW_US)


def test_a_pose_that_is_a_little_late_is_the_present() -> None:
    known = log(*at_10_hz(offset_us=-100_000))
    assert known.present(NOW_US) == arc(NOW_US - 100_000)
    assert not known.history(NOW_US)[-1].any()
