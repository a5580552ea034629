"""What the words and measures make of one minute of a real drive."""

from __future__ import annotations

import numpy as np
import pytest

from looktwice.model.driving.labeller import label_plan
from looktwice.model.driving.metrics import displacement_errors
from looktwice.model.driving.plan import TICKS, WORDS
from looktwice.model.driving.trajectory import (
    STEP_S,
    check_history,
    check_trajectory,
    constant_turn_rate,
    constant_velocity,
    present_speed,
    speeds,
)
from tests import comma2k19

HISTORIES, FUTURES = comma2k19.windows(every=1)


def test_windows_are_histories_and_futures_of_one_drive() -> None:
    assert HISTORIES.shape == (521, 16, 4)
    assert FUTURES.shape == (521, 64, 4)
    for history, future in zip(HISTORIES, FUTURES, strict=True):
        check_history(history)
        check_trajectory(future)


def test_the_poses_move_as_fast_as_the_wheels_say() -> None:
    start_s = np.load(comma2k19.SEGMENT / "global_pose" / "frame_times")[0]
    bus = comma2k19.SEGMENT / "processed_log" / "CAN" / "speed"
    wheels = np.interp(
        start_s + STEP_S * (np.arange(521) + 15), np.load(bus / "t"), np.load(bus / "value")[:, 0]
    )
    ours = np.array([present_speed(history) for history in HISTORIES])
    assert np.abs(ours - wheels).max() < 0.6
    assert np.abs(ours - wheels).mean() < 0.25


def test_the_heading_is_that_of_the_motion() -> None:
    # One second ahead the car is straight ahead: the road is nearly straight for the whole minute.
    aside = np.arctan2(FUTURES[:, 9, 1], FUTURES[:, 9, 0])
    assert np.abs(aside).max() < np.deg2rad(1)
    assert speeds(FUTURES).min() > 7


def labels(first: int) -> list[str]:
    """The longitudinal words of the minute from plans set end to end, one per tenth of a second."""
    words: list[str] = []
    for now in range(first, len(HISTORIES), TICKS):
        plan = label_plan(FUTURES[now], HISTORIES[now], None)
        words += [WORDS["longitudinal"][index] for index in plan.bins()[0]]
    return words


def test_the_plans_say_what_the_speedometer_shows() -> None:
    # Read off the plot of the minute: pulls away to 20 m/s by 10 s, brakes at 30-33 s and from 56 s on,
    # speeds up at 37-40 s and holds its speed in between.
    words = labels(0)

    def at(second: float) -> str:
        return words[round((second - 1.5) / STEP_S)]

    assert {at(second) for second in (3, 5, 8, 38, 39.5)} == {"Accelerate"}
    assert {at(second) for second in (30.5, 32, 57, 58.5)} == {"Decelerate"}
    assert {at(second) for second in (11, 15, 20, 27.5, 43, 46, 50, 55)} == {"Keep Speed"}


def test_plans_of_a_real_drive_are_short_and_straight() -> None:
    for history, future in zip(HISTORIES, FUTURES, strict=True):
        plan = label_plan(future, history, None)
        assert len(plan.longitudinal or ()) <= 4
        assert [action.word for action in plan.lateral or ()] == ["Straight"]
        assert plan.lane is None


def test_plans_made_a_moment_later_agree_about_the_same_moments() -> None:
    agreement = []
    for now in range(0, len(HISTORIES) - 10, 7):
        early = label_plan(FUTURES[now], HISTORIES[now], None).bins()[0, 10:]
        late = label_plan(FUTURES[now + 10], HISTORIES[now + 10], None).bins()[0, :-10]
        agreement.append((early == late).mean())
    assert np.mean(agreement) > 0.95


def test_kinematic_baselines_are_as_good_as_they_look() -> None:
    errors = [
        displacement_errors(np.stack([constant_velocity(history), constant_turn_rate(history)]), future)
        for history, future in zip(HISTORIES, FUTURES, strict=True)
    ]
    # Speed changes by up to 2 m/s^2: 0.5 * 2 * 6.4^2 = 41 m at the worst end, a few metres on average.
    assert 1 < np.mean([error.min_ade_m for error in errors]) < 8
    assert max(error.min_fde_m for error in errors) < 41


def test_a_mirrored_drive_has_the_same_errors() -> None:
    flip = np.array([1, -1, 1, -1], np.float32)
    for history, future in list(zip(HISTORIES, FUTURES, strict=True))[::50]:
        one = displacement_errors(constant_turn_rate(history)[None], future)
        other = displacement_errors(constant_turn_rate(history * flip)[None], future * flip)
        assert one.min_ade_m == pytest.approx(other.min_ade_m, rel=1e-6)
