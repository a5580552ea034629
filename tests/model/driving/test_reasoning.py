from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.agents import Agent, AgentKind
from looktwice.model.driving.high_level import HighLevelAction
from looktwice.model.driving.reasoning import edges_of, thoughts_of
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.thoughts import Crossing, Edges, Leader, Merging, Obstacle, Road, Thoughts
from looktwice.model.driving.trajectory import FloatArray
from tests.model.driving.drives import MIDDLES_S, agent, labelled_scene, rectangle
from tests.model.driving.roads import arc, mirrored_scene, straight

THREE_LANES = (straight(3.5), straight(0.0), straight(-3.5))
AHEAD = np.maximum(MIDDLES_S, 0)


def thoughts(*agents: Agent, speed: float = 10.0, **changes: object) -> Thoughts:
    changes = {"lane_lines": THREE_LANES, **changes}
    labelled = replace(labelled_scene(speed, agents=agents), **changes)  # type: ignore[arg-type]
    found = thoughts_of(labelled)
    assert found is not None
    return found


def test_an_empty_road() -> None:
    assert thoughts() == Thoughts(
        edges=Edges(None, None),
        leader=None,
        merging=None,
        crossing=None,
        road=Road(None, None, "both"),
        obstacle=None,
        action=HighLevelAction("maintain", "keep"),
    )


@pytest.mark.parametrize(
    ("rings", "edges"),
    [
        ((rectangle(-50, -5.25, 150, 5.25),), Edges(None, None)),
        ((rectangle(-50, -2.0, 150, 3.5),), Edges(2.5, 1.0)),
        # An island before the front bumper's left corner, and a ring as shapely closes it.
        ((rectangle(-50, -9, 150, 9), rectangle(2, 1.5, 9, 4)), Edges(0.5, None)),
        ((np.concatenate([rectangle(-50, -2.0, 150, 9), rectangle(-50, -2, 150, 9)[:1]]),), Edges(None, 1.0)),
        ((rectangle(20, -5, 50, 5),), Edges(0.0, 0.0)),
    ],
)
def test_edges_are_told_in_half_metres(rings: tuple[FloatArray, ...], edges: Edges) -> None:
    assert edges_of(rings) == edges


@pytest.mark.parametrize(
    ("somebody", "leader"),
    [
        (agent(24.5, 0.0, 10.0), Leader("", 20)),
        (agent(24.5, 0.5, 6.0), Leader("slower", 20)),
        (agent(24.5, 0.0), Leader("standing", 20)),
        (replace(agent(24.5, 0.0, 10.0), lights=frozenset({"brake"})), Leader("braking", 20)),
        (agent(90.0, 0.0), None),
        (agent(-15.0, 0.0, 10.0), None),
        (agent(24.5, 3.5, 10.0), None),
        (agent(24.5, 0.0, 5.0, np.pi), None),
    ],
)
def test_cipo_1_leads_in_the_own_lane(somebody: Agent, leader: Leader | None) -> None:
    assert thoughts(somebody).leader == leader


def test_the_time_of_a_crossing_counts_where_a_track_has_gaps() -> None:
    walker = agent(32.0, -4.5, 1.5, np.pi / 2, "pedestrian")
    poses = walker.poses.copy()
    poses[20:30] = np.nan
    seen, gap = thoughts(walker).crossing, thoughts(replace(walker, poses=poses)).crossing
    assert seen == gap is not None


def test_of_two_ahead_the_nearer_leads() -> None:
    assert thoughts(agent(45.0, 0.0, agent_id=2), agent(24.5, 0.0, 10.0)).leader == Leader("", 20)


@pytest.mark.parametrize(
    ("somebody", "merging"),
    [
        # By relative velocity: 1 m/s to the right brings it into the lane within 3 s; 0.1 m/s does not.
        (agent(24.5, 3.5, 10.0, -0.1), Merging("left", 20)),
        (agent(24.5, 3.5, 10.0, -0.01), None),
        (agent(24.5, 3.5, 10.0, 0.1), None),
        (agent(5.0, -3.5, 10.0, 0.1), Merging("right", 0)),
        (replace(agent(14.5, -3.5, 8.0), lights=frozenset({"left"})), Merging("right", 10)),
        (replace(agent(14.5, -3.5, 8.0), lights=frozenset({"left", "right"})), None),
        (replace(agent(14.5, -3.5, 8.0), lights=frozenset({"right"})), None),
        (agent(14.5, 3.5, 0.0), None),
        (agent(60.0, 3.5, 10.0, -0.1), None),
    ],
)
def test_cipo_2_merges_from_a_lane_beside(somebody: Agent, merging: Merging | None) -> None:
    assert thoughts(somebody).merging == merging


@pytest.mark.parametrize(("x_m", "speed_ms", "merges"), [(15.0, 10.0, True), (15.0, 1.0, False)])
def test_cipo_2_is_told_by_the_geometry_of_lanes(x_m: float, speed_ms: float, merges: bool) -> None:
    # Its lane leads into the ego's 40 m ahead. Who crawls is there long behind the ego.
    ramp = np.array([[-20, -3.5], [20, -3.5], [30, -2.0], [40, 0.0]], np.float32)
    lines = (straight(0.0, -50, 40), straight(0.0, 40, 150), ramp)
    found = thoughts(agent(x_m, -3.5, speed_ms), lane_lines=lines)
    assert found.merging == (Merging("right", 10) if merges else None)


@pytest.mark.parametrize(
    ("somebody", "crossing"),
    [
        # 15 m ahead, where the ego is within 1.5 s; at 2 m/s the first is in the ego's way after 2 s.
        (agent(17.0, 5.5, 2.0, -np.pi / 2, "pedestrian"), Crossing("pedestrian", "left", 15, first=False)),
        (agent(32.0, -4.5, 1.5, np.pi / 2, "pedestrian"), Crossing("pedestrian", "right", 30, first=True)),
        (agent(27.0, -9.0, 5.0, np.pi / 2), Crossing("vehicle", "right", 25, first=True)),
        (agent(17.0, 5.5, 2.0, np.pi / 2, "pedestrian"), None),
        (agent(17.0, 5.5, 0.0, -np.pi / 2, "pedestrian"), None),
        # It comes 4 s too late.
        (agent(12.0, 9.0, 1.7, -np.pi / 2, "pedestrian"), None),
        (agent(40.0, 0.0, 8.0, np.pi), Crossing("vehicle", "oncoming", 35, first=False)),
        (agent(24.5, 3.5, 10.0), None),
    ],
)
def test_whose_way_crosses_the_egos(somebody: Agent, crossing: Crossing | None) -> None:
    assert thoughts(somebody).crossing == crossing


@pytest.mark.parametrize("kind", ["cone", "barrier", "pedestrian"])
def test_what_stands_in_the_way(kind: AgentKind) -> None:
    assert thoughts(agent(22.0, 0.5, kind=kind)).obstacle == Obstacle(kind, 20)  # type: ignore[arg-type]
    assert thoughts(agent(22.0, 3.0, kind=kind)).obstacle is None


def test_a_bend() -> None:
    lines = (straight(0.0, -50, 20), arc(30, -np.pi / 2, (20.0, 0.0)))
    assert thoughts(lane_lines=lines).road == Road("right", 25, "none")


def test_who_is_hidden_is_not_told_of() -> None:
    walker = agent(30.0, 5.5, 1.5, -np.pi / 2, "pedestrian", agent_id=2)
    assert thoughts(walker).crossing is not None
    assert thoughts(walker, agent(12.0, 2.2, 10.0, size_m=(8.0, 2.5, 3.0))).crossing is None


def test_without_a_road_nothing_is_said() -> None:
    labelled = labelled_scene()
    assert thoughts_of(replace(labelled, lane_lines=())) is None
    assert thoughts_of(replace(labelled, drivable=())) is None


@st.composite
def scenes(draw: st.DrawFn) -> LabelledScene:
    number = st.floats(-1, 1, allow_nan=False)
    kinds: st.SearchStrategy[AgentKind] = st.sampled_from(["vehicle", "pedestrian", "cone", "barrier"])
    agents = tuple(
        replace(
            agent(
                5 + 30 * (1 + draw(number)),
                7 * draw(number),
                10 * abs(draw(number)),
                4 * draw(number),
                draw(kinds),
                number_,
            ),
            lights=frozenset(draw(st.sets(st.sampled_from(["left", "right", "brake"])))),
        )
        for number_ in range(draw(st.integers(0, 4)))
    )
    speed = np.clip(10 + 3 * draw(number) * AHEAD, 0, 25)
    edges = rectangle(-50, -5.25 + 3 * draw(number), 150, 5.25 + 3 * draw(number))
    return replace(labelled_scene(speed, 0.1 * draw(number), agents=agents), drivable=(edges,))


@given(scenes())
def test_a_mirrored_scene_teaches_mirrored_thoughts(labelled: LabelledScene) -> None:
    found = thoughts_of(labelled)
    assert found is not None
    assert thoughts_of(mirrored_scene(labelled)) == found.mirrored()
