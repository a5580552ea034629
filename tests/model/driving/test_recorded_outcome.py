"""What comes of trajectories among others who move as they were recorded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.agents import Agent
from looktwice.model.driving.lane_map import LaneArea, LaneMap
from looktwice.model.driving.outcome import VERDICTS, Verdict
from looktwice.model.driving.recorded_outcome import verdicts_among_recorded
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray
from tests.model.driving.drives import MIDDLES_S, agent, drive, labelled_scene, rectangle

LANE_MAP = LaneMap(
    lanes=(
        LaneArea(1, rectangle(-50, -5.25, 150, -1.75), on_route=True),
        LaneArea(2, rectangle(-50, -1.75, 150, 1.75), on_route=True),
        LaneArea(3, rectangle(-50, 1.75, 150, 5.25), on_route=False),
    ),
    intersections=(),
    centreline=np.array([[-50, 0], [150, 0]], np.float32),
    has_lights=False,
)


def cruising(*agents: Agent) -> LabelledScene:
    return replace(labelled_scene(10.0, agents=agents), lane_map=LANE_MAP)


def verdict(labelled: LabelledScene, trajectory: FloatArray) -> Verdict:
    found = verdicts_among_recorded(labelled, trajectory[None])
    assert found is not None
    assert found.shape == (1,)
    return VERDICTS[int(found[0])]


def straight(speed_ms: float, left_m: float = 0.0) -> FloatArray:
    """Gently from 10 m/s to a speed, drifting so far to the left in the end."""
    gently = np.clip(speed_ms - 10.0, -1.5 * MIDDLES_S.clip(0), 1.5 * MIDDLES_S.clip(0))
    trajectory, _ = drive(10.0 + gently)
    trajectory[:, 1] = left_m * np.linspace(0, 1, FUTURE_STEPS) ** 2
    return trajectory


@pytest.mark.parametrize(
    ("trajectory", "comes_to"),
    [
        (straight(10.0), "holds"),
        (straight(9.0), "holds"),
        (straight(4.0), "behind"),
        (straight(16.0), "ahead"),
        (straight(10.0, left_m=3.0), "off_route"),
        (straight(10.0, left_m=-6.0), "off_road"),
        (straight(10.0, left_m=-2.0), "holds"),
    ],
)
def test_trajectories_fail_at_what_they_do(trajectory: FloatArray, comes_to: Verdict) -> None:
    assert verdict(cruising(), trajectory) == comes_to


def test_a_rough_ride_fails_at_comfort() -> None:
    rough, _ = drive(np.where(np.arange(79) // 10 % 2, 14.0, 6.0))
    assert verdict(cruising(), rough) == "comfort"


def test_running_into_somebody_is_a_failure_and_being_run_into_from_behind_is_none() -> None:
    assert verdict(cruising(agent(80.0, -3.0, kind="barrier")), straight(10.0)) == "holds"
    slow = cruising(agent(40.0, -3.5, speed=2.0))
    assert verdict(slow, straight(10.0)) == "holds"
    assert verdict(slow, straight(10.0, left_m=-3.5)) == "collision"
    from_behind = cruising(agent(-12.0, 0.0, speed=11.0))
    assert verdict(from_behind, straight(9.0)) == "holds"
    assert verdict(from_behind, straight(5.0)) == "behind"
    walker = cruising(agent(20.0, 14.0, speed=2.0, heading=-np.pi / 2, kind="pedestrian"))
    assert verdict(walker, straight(10.0)) == "holds", "it has passed before"
    assert verdict(walker, straight(3.0)) in ("collision", "behind")


def test_an_answer_does_not_depend_on_the_other_trajectories() -> None:
    labelled = cruising(agent(40.0, -3.5, speed=2.0))
    asked = [straight(10.0), straight(10.0, left_m=-3.5), straight(5.0)]
    together = verdicts_among_recorded(labelled, np.stack(asked))
    assert together is not None
    assert [VERDICTS[each] for each in together] == [verdict(labelled, each) for each in asked]


def test_nobody_can_tell_without_road_or_lanes_or_where_the_expert_fails_too() -> None:
    known, way = cruising(), straight(10.0)[None]
    assert verdicts_among_recorded(replace(known, lane_map=None), way) is None
    assert verdicts_among_recorded(replace(known, drivable=()), way) is None
    assert verdicts_among_recorded(cruising(agent(30.0, 0.0)), way) is None


def test_the_expert_s_own_roughness_is_forgiven() -> None:
    rough, _ = drive(np.where(np.arange(79) // 10 % 2, 14.0, 6.0))
    labelled = replace(cruising(), future=rough)
    assert verdict(labelled, rough) == "holds"
