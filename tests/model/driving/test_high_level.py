from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.high_level import (
    HighLevelAction,
    Lateral,
    Longitudinal,
    action_of,
)
from looktwice.model.driving.lane_graph import LaneGraph
from looktwice.model.driving.trajectory import TEN_HZ_S, FloatArray, GeometryError, at_times
from tests.model.driving.drives import MIDDLES_S, Array, drive, mirrored
from tests.model.driving.roads import arc, flipped, junction, straight

AHEAD: Array = np.maximum(MIDDLES_S, 0)
HALF_SECONDS = tuple(0.5 * step for step in range(1, 9))
THREE_LANES = (straight(3.5), straight(0.0), straight(-3.5))
ACTIONS = st.builds(HighLevelAction)


def sideways(left_m: float, *, within_s: float = 3.5) -> FloatArray:
    """At 10 m/s, over to the left within some seconds."""
    time_s = np.array(TEN_HZ_S)
    share = np.clip(time_s / within_s, 0, 1)
    poses = np.zeros((64, 4))
    poses[:, 0] = 10 * time_s
    poses[:, 1] = left_m * (3 * share**2 - 2 * share**3)
    poses[:, 3] = np.arctan2(np.gradient(poses[:, 1]), np.gradient(poses[:, 0]))
    return poses.astype(np.float32)


def bent(turned_rad: float, begins_m: float = 10.0) -> FloatArray:
    """At 5 m/s straight on, then along an arc of 12 m."""
    yaw_rate = np.where(begins_m < 5 * MIDDLES_S, np.sign(turned_rad) * 5 / 12, 0.0)
    return drive(5.0, yaw_rate)[0]


@pytest.mark.parametrize(
    ("speed", "state"),
    [
        (np.full(79, 8.0), "maintain"),
        (8 + 0.2 * AHEAD, "maintain"),
        (8 + AHEAD, "accelerate"),
        (8 - AHEAD, "decelerate"),
        (np.zeros(79), "stop"),
        (np.maximum(0, 6 - 2 * AHEAD), "stop"),
        # Who sets off after a wait accelerates; who brakes hard and goes on slowly decelerates.
        (np.maximum(0, 2 * (AHEAD - 2)), "accelerate"),
        (np.maximum(4, 12 - 4 * AHEAD), "decelerate"),
        # One dab of half a second does not count, nor what comes behind the horizon.
        (8 - 1.5 * np.clip(AHEAD - 2, 0, 0.3), "maintain"),
        (8 + 2 * np.maximum(AHEAD - 4.2, 0), "maintain"),
    ],
)
def test_speed_is_one_of_four_states(speed: Array, state: Longitudinal) -> None:
    future, _ = drive(speed)
    # Eight poses say as much as 64, and so they do as a model writes them.
    eight = at_times(future, TEN_HZ_S, HALF_SECONDS)
    road = LaneGraph(THREE_LANES)
    for told in (
        action_of(future, road),
        action_of(eight, road, HALF_SECONDS),
        action_of(np.round(eight, 1), road, HALF_SECONDS),
    ):
        assert told == HighLevelAction(state, "keep")


@pytest.mark.parametrize(
    ("future", "lines", "manoeuvre"),
    [
        (sideways(0.0), THREE_LANES, "keep"),
        (sideways(1.0), THREE_LANES, "keep"),
        (sideways(3.5), THREE_LANES, "change left"),
        (bent(np.pi / 2), junction(), "turn left"),
        (drive(5.0)[0], junction(), "keep"),
        # The road bends, and so does who keeps the lane.
        (bent(np.pi / 2), (straight(0.0, -50, 10), arc(12, np.pi / 2, (10.0, 0.0))), "keep"),
        # Who turns where no lane does turns.
        (bent(np.pi / 2), THREE_LANES, "turn left"),
        # Who stands goes nowhere.
        (drive(0.0)[0], junction(), "keep"),
    ],
)
def test_direction_is_told_against_the_lanes(
    future: FloatArray, lines: tuple[FloatArray, ...], manoeuvre: Lateral
) -> None:
    action = action_of(future, LaneGraph(lines))
    assert action is not None
    assert action.lateral == manoeuvre
    assert action_of(mirrored(future), LaneGraph(flipped(lines))) == action.mirrored()
    assert action_of(at_times(future, TEN_HZ_S, HALF_SECONDS), LaneGraph(lines), HALF_SECONDS) == action


def test_off_all_lanes_nothing_is_told() -> None:
    assert action_of(sideways(0.0), LaneGraph(())) is None
    assert action_of(sideways(0.0), LaneGraph((straight(8.0),))) is None
    # A lane without any length is none.
    assert action_of(sideways(0.0), LaneGraph((straight(0.0, 1.0, 1.01),))) is None
    # Nor is somebody on a lane who drives against it.
    assert action_of(sideways(0.0), LaneGraph((straight(0.0)[::-1],))) is None


def test_a_short_trajectory_is_refused() -> None:
    with pytest.raises(GeometryError, match="must reach 4 s to be judged, it ends at 3 s"):
        action_of(np.zeros((3, 4), np.float32), LaneGraph(THREE_LANES), (1.0, 2.0, 3.0))


@given(ACTIONS)
def test_a_mirrored_action_mirrored_is_itself(action: HighLevelAction) -> None:
    assert action.mirrored().mirrored() == action
    assert (action.mirrored() == action) == (action.lateral == "keep")
