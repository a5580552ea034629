"""Mends change what they name, in the direction that they name, and nothing else."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.direction import Change, wanted_changes
from looktwice.model.driving.labeller import label_plan
from looktwice.model.driving.mends import MENDS, Mend, groups_of, mend_within, mended, mended_plan
from looktwice.model.driving.plan import GROUPS, parse_plan
from looktwice.model.driving.trajectory import (
    FUTURE_STEPS,
    HISTORY_STEPS,
    POSE_MIRROR,
    STEP_S,
    FloatArray,
    constant_turn_rate,
    path_length,
)


def steady(speed_ms: float, yaw_rate: float = 0.0) -> FloatArray:
    """The history [16, 4] of a car that keeps its speed, and how fast it turns."""
    time_s = STEP_S * np.arange(1 - HISTORY_STEPS, 1)
    heading = yaw_rate * time_s
    history = np.zeros((HISTORY_STEPS, 4))
    chord = speed_ms * time_s * np.sinc(heading / 2 / np.pi)
    history[:, 0], history[:, 1] = chord * np.cos(heading / 2), chord * np.sin(heading / 2)
    history[:, 3] = heading
    return history.astype(np.float32)


HISTORY = steady(10.0)
STRAIGHT = constant_turn_rate(HISTORY)
BENDS = constant_turn_rate(steady(12.0, 0.15))
EXPERT = parse_plan(
    "- longitudinal\n  - 0.0s-6.4s: Accelerate\n- lateral\n  - 0.0s-6.4s: Left Turn\n"
    "- lane\n  - 0.0s-6.4s: Left Lane Change\n"
)
KEEP = parse_plan(
    "- longitudinal\n  - 0.0s-6.4s: Keep Speed\n- lateral\n  - 0.0s-6.4s: Straight\n"
    "- lane\n  - 0.0s-6.4s: Keep Lane\n"
)


@pytest.mark.parametrize(
    ("mend", "metres"),
    [
        ("ease off", 64 - 0.25 * 10 * (1.6 + 3.2)),
        ("slow down", 64 - 0.4 * 10 * (1.6 + 3.2)),
        ("speed up", 64 + 0.7 * 6.4**2 / 2),
        ("accelerate", 64 + 1.4 * 6.4**2 / 2),
        ("brake", 10**2 / (2 * 2.0)),
        ("brake hard", 10**2 / (2 * 3.5)),
        ("the expert's pace", 12 * 6.4),
        ("the expert's way", 64),
        ("the expert's", 12 * 6.4),
    ],
)
def test_how_far_a_mended_trajectory_goes(mend: Mend, metres: float) -> None:
    changed = mended(mend, STRAIGHT, BENDS, HISTORY)
    assert changed.dtype == np.float32
    assert path_length(changed) == pytest.approx(metres, abs=1.0)
    bends = mend in ("the expert's way", "the expert's")
    assert bool(np.abs(changed[:, 1]).max() > 5) is bends, "the way is kept, or it is the expert's"


def test_the_first_mends_grow() -> None:
    slower = [mended(mend, STRAIGHT, BENDS, HISTORY) for mend in ("ease off", "slow down", "brake")]
    faster = [mended(mend, STRAIGHT, BENDS, HISTORY) for mend in ("speed up", "accelerate")]
    lengths = [path_length(each) for each in (*faster[::-1], STRAIGHT, *slower)]
    assert all(more > less for more, less in pairwise(lengths))


@given(st.sampled_from(MENDS), st.floats(0.0, 25.0), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_mends_know_no_left_and_right_and_never_reverse(
    mend: Mend, speed_ms: float, own: float, other: float
) -> None:
    history = steady(speed_ms, own)
    trajectory = constant_turn_rate(history)
    expert = constant_turn_rate(steady(speed_ms + 1, other))
    changed = mended(mend, trajectory, expert, history)
    assert changed.shape == (FUTURE_STEPS, 4)
    assert np.isfinite(changed).all()
    seen = mended(mend, trajectory * POSE_MIRROR, expert * POSE_MIRROR, history * POSE_MIRROR)
    np.testing.assert_allclose(seen, changed * POSE_MIRROR, atol=1e-3)
    steps = np.diff(changed[:, :2], axis=0, prepend=np.zeros((1, 2)))
    along = steps[:, 0] * np.cos(changed[:, 3]) + steps[:, 1] * np.sin(changed[:, 3])
    assert (along > -0.01).all()


@pytest.mark.parametrize(
    ("mend", "changes"),
    [
        ("slow down", {"slower"}),
        ("brake hard", {"slower"}),
        ("accelerate", {"faster"}),
        ("the expert's way", {"left", "lane_left"}),
        ("the expert's", {"faster", "left", "lane_left"}),
    ],
)
def test_a_mended_plan_says_what_was_changed(mend: Mend, changes: set[Change]) -> None:
    changed = mended(mend, STRAIGHT, BENDS, HISTORY)
    plan = mended_plan(mend, KEEP, changed, EXPERT, HISTORY)
    assert {change for some in wanted_changes(KEEP, plan) for change in some} == changes
    for group in GROUPS:
        if group not in groups_of(mend):
            assert plan.track(group) == KEEP.track(group)
    if mend != "the expert's":
        told = label_plan(changed, HISTORY, None)
        assert plan.longitudinal in (told.longitudinal, KEEP.longitudinal)


def test_of_a_mend_is_left_what_is_spoken_of() -> None:
    pace, way = groups_of("brake"), groups_of("the expert's way")
    assert mend_within("the expert's", pace | way) == "the expert's"
    assert mend_within("the expert's", pace) == "the expert's pace"
    assert mend_within("the expert's", frozenset({"lane"})) == "the expert's way"
    assert mend_within("the expert's", frozenset({"longitudinal", "lane"})) == "the expert's"
    assert mend_within("brake", pace | way) == "brake"
    assert mend_within("the expert's way", frozenset({"lateral"})) == "the expert's way"
    assert mend_within("brake", way) is None
    assert mend_within("the expert's", frozenset()) is None
