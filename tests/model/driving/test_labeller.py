from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from looktwice.model.driving.labeller import MIN_DURATION, label_plan
from looktwice.model.driving.plan import TICKS, Track
from looktwice.model.driving.scene import TRACK_STEPS, LaneTrace
from looktwice.model.driving.trajectory import GeometryError
from tests.model.driving.drives import MIDDLES_S, ROWS_S, drive, mirrored

LANES = 4
LANE_WIDTH_M = 3.5


def words(track: Track | None) -> list[str]:
    assert track is not None
    return [action.word for action in track]


def longitudinal(speed: NDArray[np.float64] | float) -> Track:
    track = label_plan(*drive(speed), None).longitudinal
    assert track is not None
    return track


def lateral(speed: NDArray[np.float64] | float, yaw_rate: NDArray[np.float64] | float) -> Track:
    track = label_plan(*drive(speed, yaw_rate), None).lateral
    assert track is not None
    return track


def lane_trace(sideways_m: NDArray[np.float64], start_lane: int = 2) -> LaneTrace:
    """The trace of an ego that is ``sideways_m`` [80] to the left of the start lane's centre."""
    passed = np.round(sideways_m / LANE_WIDTH_M)
    return LaneTrace(
        road=np.full(TRACK_STEPS, 7, np.int32),
        lane=(start_lane - passed).astype(np.int16),
        offset_m=(sideways_m - passed * LANE_WIDTH_M).astype(np.float32),
    )


def shift(start_s: float, duration_s: float, metres: float = LANE_WIDTH_M) -> NDArray[np.float64]:
    """A smooth move sideways [80]."""
    s = np.clip((ROWS_S - start_s) / duration_s, 0, 1)
    return np.asarray(metres * (10 * s**3 - 15 * s**4 + 6 * s**5))


def lane(trace: LaneTrace) -> Track | None:
    return label_plan(*drive(12.0), trace).lane


def mirrored_trace(trace: LaneTrace) -> LaneTrace:
    lanes = np.where(trace.lane >= 0, LANES - 1 - trace.lane, trace.lane).astype(np.int16)
    return LaneTrace(trace.road, lanes, -trace.offset_m)


# Longitudinal


def test_constant_speed_on_a_straight_is_one_segment_a_track() -> None:
    plan = label_plan(*drive(10.0), None)
    assert str(plan) == "- longitudinal\n  - 0.0s-6.4s: Keep Speed\n- lateral\n  - 0.0s-6.4s: Straight\n"


def test_braking_to_a_stop_is_decelerate_then_wait() -> None:
    stopping, waiting = longitudinal(np.maximum(0, 10 - 2.5 * np.maximum(MIDDLES_S, 0)))
    assert (stopping.word, waiting.word) == ("Decelerate", "Wait")
    assert 38 <= stopping.end <= 42  # it stands at 4.0 s


def test_pulling_away_is_wait_then_accelerate() -> None:
    waiting, starting = longitudinal(1.5 * np.maximum(MIDDLES_S - 2, 0))
    assert (waiting.word, starting.word) == ("Wait", "Accelerate")
    assert 20 <= waiting.end <= 25


def test_standing_all_the_time_is_wait() -> None:
    assert words(longitudinal(0.0)) == ["Wait"]


def test_driving_backwards_is_reverse_even_while_it_gets_faster() -> None:
    assert words(longitudinal(-2.0)) == ["Reverse"]
    assert words(longitudinal(np.minimum(0, -(MIDDLES_S - 2)))) == ["Wait", "Reverse"]


def test_changing_gear_passes_through_wait() -> None:
    speed = np.interp(MIDDLES_S, [1, 3, 4.2, 6], [3, 0, 0, -2.5])
    assert words(longitudinal(speed)) == ["Keep Speed", "Decelerate", "Wait", "Reverse"]


def test_a_gentle_drift_of_speed_is_keep_speed_and_a_clear_one_is_not() -> None:
    assert words(longitudinal(20 + 0.3 * MIDDLES_S)) == ["Keep Speed"]
    assert words(longitudinal(20 + 0.5 * MIDDLES_S)) == ["Accelerate"]
    assert words(longitudinal(20 - 0.5 * MIDDLES_S)) == ["Decelerate"]


def test_a_dab_on_the_brake_is_too_small_a_change_of_speed() -> None:
    speed = 15 - np.interp(MIDDLES_S, [3, 3.8], [0, 0.4])
    assert words(longitudinal(speed)) == ["Keep Speed"]


def test_noise_on_the_speed_leaves_one_segment() -> None:
    noise = np.random.default_rng(3).normal(0, 0.15, MIDDLES_S.shape)
    assert words(longitudinal(12 + noise)) == ["Keep Speed"]


def test_what_began_before_the_present_holds_from_the_first_tick() -> None:
    first = longitudinal(np.maximum(5.0, 12 - 2 * (MIDDLES_S + 1.5)))[0]
    assert (first.start, first.word) == (0, "Decelerate")


# Lateral


@pytest.mark.parametrize(("sign", "word"), [(1, "Left Turn"), (-1, "Right Turn")])
def test_a_turn_at_an_intersection(sign: int, word: str) -> None:
    quarter = np.where((MIDDLES_S > 1) & (MIDDLES_S < 4), sign * np.pi / 6, 0.0)
    track = lateral(6.0, quarter)
    assert words(track) == ["Straight", word, "Straight"]
    assert 6 <= track[1].start <= 11
    assert 39 <= track[1].end <= 44


def test_curves_count_as_turns_by_their_radius() -> None:
    assert words(lateral(25.0, 25 / 250)) == ["Straight"]  # a highway's curve
    assert words(lateral(15.0, 15 / 60)) == ["Left Turn"]  # a ramp


def test_a_turn_once_begun_lasts_until_the_road_is_clearly_straighter() -> None:
    radius = np.where(MIDDLES_S < 3, 120.0, 200.0)
    assert words(lateral(14.0, 14 / radius)) == ["Left Turn"]
    assert words(lateral(14.0, 14 / 200)) == ["Straight"]


def test_swinging_out_and_back_is_no_turn() -> None:
    # A lane change at 40 km/h: the heading never leaves the road's by 10 degrees.
    yaw_rate = np.where(np.abs(MIDDLES_S - 3) < 1.5, 0.17 * np.sin((MIDDLES_S - 1.5) / 3 * 2 * np.pi), 0.0)
    assert words(lateral(11.0, yaw_rate)) == ["Straight"]


def test_steering_for_a_lane_change_is_no_turn_where_the_lanes_are_known() -> None:
    # At 18 km/h the heading swings by 30 degrees; a turn of 60 degrees meanwhile is still a turn.
    there_and_back = np.where(np.abs(MIDDLES_S - 3) < 2, np.sin((MIDDLES_S - 1) / 4 * 2 * np.pi), 0.0)
    future, history = drive(5.0, 0.42 * there_and_back)
    change = lane_trace(shift(1, 4))
    assert words(label_plan(future, history, None).lateral) == [
        "Straight",
        "Left Turn",
        "Right Turn",
        "Straight",
    ]
    plan = label_plan(future, history, change)
    assert words(plan.lateral) == ["Straight"]
    assert words(plan.lane) == ["Keep Lane", "Left Lane Change", "Keep Lane"]
    turning = label_plan(*drive(5.0, np.where(np.abs(MIDDLES_S - 3) < 2, 0.27, 0.0)), change)
    assert words(turning.lateral) == ["Straight", "Left Turn", "Straight"]


def test_a_standing_car_does_not_turn() -> None:
    wobble = 0.015 * np.sin(7 * MIDDLES_S)
    assert words(lateral(0.05, wobble)) == ["Straight"]


def test_a_turn_across_half_a_circle_is_one_turn() -> None:
    # The heading passes from pi to -pi on the way.
    assert words(lateral(6.0, 0.6)) == ["Left Turn"]


# Lane


def test_without_lanes_there_is_no_lane_group() -> None:
    assert label_plan(*drive(12.0), None).lane is None


def test_an_unknown_lane_ahead_leaves_the_group_out_and_one_in_the_past_does_not() -> None:
    trace = lane_trace(np.zeros(TRACK_STEPS))
    ahead, past = trace.lane.copy(), trace.lane.copy()
    ahead[70], past[3] = -1, -1
    assert lane(LaneTrace(trace.road, ahead, trace.offset_m)) is None
    assert words(lane(LaneTrace(trace.road, past, trace.offset_m))) == ["Keep Lane"]


@pytest.mark.parametrize(("sign", "word"), [(1, "Left Lane Change"), (-1, "Right Lane Change")])
def test_a_lane_change_lasts_from_moving_to_settled(sign: int, word: str) -> None:
    track = lane(lane_trace(sign * shift(1, 4)))
    assert track is not None
    assert words(track) == ["Keep Lane", word, "Keep Lane"]
    assert 10 <= track[1].start <= 16  # it starts to move at 1.0 s, very gently
    assert 44 <= track[1].end <= 50


def test_a_lane_change_under_way_at_the_present_ends_in_the_plan() -> None:
    assert words(lane(lane_trace(shift(-1, 4)))) == ["Left Lane Change", "Keep Lane"]


def test_a_lane_change_that_crosses_in_time_but_does_not_finish() -> None:
    assert words(lane(lane_trace(shift(4, 4)))) == ["Keep Lane", "Left Lane Change"]


def test_a_lane_change_that_pauses_astride_the_line_is_one() -> None:
    # 2.4 m by 2 s, a second's pause 1.1 m from the new lane's centre, then the rest.
    track = lane(lane_trace(shift(0, 2, 2.4) + shift(3, 2, 1.1)))
    assert track is not None
    assert words(track)[-2:] == ["Left Lane Change", "Keep Lane"]
    assert track[-2].start < 10
    assert 40 <= track[-2].end <= 50


def test_two_lanes_at_once_are_one_long_lane_change() -> None:
    assert words(lane(lane_trace(shift(1, 5, 2 * LANE_WIDTH_M)))) == [
        "Keep Lane",
        "Left Lane Change",
        "Keep Lane",
    ]


def test_there_and_back_again_is_two_lane_changes() -> None:
    away_and_back = shift(-1, 3) - shift(3, 3)
    assert words(lane(lane_trace(away_and_back))) == [
        "Left Lane Change",
        "Keep Lane",
        "Right Lane Change",
        "Keep Lane",
    ]


def test_other_numbers_on_the_next_road_are_no_lane_change() -> None:
    trace = lane_trace(np.zeros(TRACK_STEPS))
    road, number = trace.road.copy(), trace.lane.copy()
    road[40:], number[40:] = 8, 0
    offset = trace.offset_m.copy()
    offset[40:] = 0.4
    assert words(lane(LaneTrace(road, number, offset))) == ["Keep Lane"]


def test_riding_on_the_line_is_no_lane_change() -> None:
    sideways = LANE_WIDTH_M / 2 + 0.3 * np.sin(2 * ROWS_S)
    assert words(lane(lane_trace(sideways))) == ["Keep Lane"]


# Any sane drive


@st.composite
def drives(draw: st.DrawFn) -> tuple[NDArray[np.float64], NDArray[np.float64], LaneTrace | None]:
    """Speeds, yaw rates and lanes a car could have: bounded accelerations, noise included."""
    knots_s = np.linspace(-1.5, 6.4, 8)
    acceleration = draw(st.lists(st.floats(-8, 4), min_size=8, max_size=8))
    speed = draw(st.floats(-3, 35)) + np.cumsum(np.interp(MIDDLES_S, knots_s, acceleration)) * 0.1
    speed = np.maximum(speed, draw(st.sampled_from([-5.0, 0.0])))
    curvature = np.interp(MIDDLES_S, knots_s, draw(st.lists(st.floats(-0.15, 0.15), min_size=8, max_size=8)))
    yaw_rate = curvature * np.clip(speed, -8, 8)
    noise = np.random.default_rng(draw(st.integers(0, 99))).normal(0, 1, (2, len(MIDDLES_S)))
    strength = draw(st.sampled_from([0.0, 0.02, 0.3]))
    trace = None
    if draw(st.booleans()):
        moves = draw(st.lists(st.tuples(st.floats(-2, 6), st.floats(1.5, 6)), max_size=2))
        sideways = sum((shift(start, duration) for start, duration in moves), np.zeros(TRACK_STEPS))
        trace = lane_trace(sideways + draw(st.floats(-0.5, 0.5)))
    return speed + strength * noise[0], yaw_rate + 0.1 * strength * noise[1], trace


@settings(max_examples=150, deadline=None)
@given(drives())
def test_any_sane_drive_gives_a_partition_into_few_segments(
    case: tuple[NDArray[np.float64], NDArray[np.float64], LaneTrace | None],
) -> None:
    speed, yaw_rate, trace = case
    plan = label_plan(*drive(speed, yaw_rate), trace)  # Plan itself checks the partition
    assert (plan.lane is None) == (trace is None)
    for _, track in plan.tracks():
        assert len(track) <= TICKS // MIN_DURATION
        assert min(action.end - action.start for action in track) >= MIN_DURATION
        assert all(one.word != other.word for one, other in pairwise(track))


@settings(max_examples=150, deadline=None)
@given(drives())
def test_a_mirrored_drive_has_the_mirrored_plan(
    case: tuple[NDArray[np.float64], NDArray[np.float64], LaneTrace | None],
) -> None:
    speed, yaw_rate, trace = case
    future, history = drive(speed, yaw_rate)
    plan = label_plan(future, history, trace)
    other = label_plan(mirrored(future), mirrored(history), None if trace is None else mirrored_trace(trace))
    assert other == plan.mirrored()


def test_wrong_arrays_are_refused() -> None:
    future, history = drive(10.0)
    with pytest.raises(GeometryError, match="trajectory must have shape"):
        label_plan(future[:-1], history, None)
    with pytest.raises(GeometryError, match="history must end at the present"):
        label_plan(future, history + 1, None)
