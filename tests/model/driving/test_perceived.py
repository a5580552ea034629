"""What is perceived by rule: who is visible, the road's edges, and who comes into the safe zone when."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.agents import AGENT_KINDS, Agent
from looktwice.model.driving.perceived import (
    MAX_PERCEIVED,
    ROW_SIZE,
    SAFE_TIMES_S,
    Perceived,
    PerceivedAgent,
    perceived_of,
    perceived_of_row,
)
from looktwice.model.driving.scene import LabelledScene
from tests.model.driving.drives import agent, labelled_scene
from tests.model.driving.roads import mirrored_scene

_METRES = st.floats(-60, 60, width=32)
_SIDES = st.floats(0.125, 20, width=32)
AGENTS = st.builds(
    PerceivedAgent,
    st.sampled_from(AGENT_KINDS),
    _METRES,
    _METRES,
    _SIDES,
    _SIDES,
    st.sampled_from([None, *SAFE_TIMES_S]),
)
PERCEIVED = st.builds(
    Perceived,
    st.lists(AGENTS, max_size=MAX_PERCEIVED).map(tuple),
    *[st.floats(0, 60, width=32) | st.just(math.inf)] * 2,
)


def seen(*agents: Agent, speed: float = 10.0) -> Perceived:
    perceived = perceived_of(labelled_scene(speed, agents=agents))
    assert perceived is not None
    return perceived


@given(PERCEIVED)
def test_a_row_tells_all(perceived: Perceived) -> None:
    row = perceived.row()
    assert row.shape == (ROW_SIZE,)
    assert row.dtype == np.float32
    assert perceived_of_row(row) == perceived
    assert perceived.mirrored().mirrored() == perceived
    assert perceived_of_row(np.full(ROW_SIZE, np.nan, np.float32)) is None


def test_who_is_visible_is_told_of_the_nearest_first() -> None:
    found = seen(
        agent(30.0, -3.5, kind="cone", size_m=(0.4, 0.3, 0.7)),
        agent(20.0, 3.5),
        agent(-20.0, 0.0),  # behind
        agent(200.0, 0.0),  # too far
        replace(agent(10.0, 0.0), poses=np.full((80, 3), np.nan, np.float32)),  # not there
    )
    assert [(each.kind, each.x_m, each.y_m) for each in found.agents] == [
        ("vehicle", 20.0, 3.5),
        ("cone", 30.0, -3.5),
    ]
    assert found.agents[1].length_m == pytest.approx(0.4)
    assert found.agents[1].width_m == pytest.approx(0.3)
    crowd = seen(*(agent(10.0 + each, 20.0 - each, size_m=(0.5, 0.1, 1.7)) for each in range(12)))
    assert len(crowd.agents) == MAX_PERCEIVED


def test_the_edges_of_the_road_are_told_from_the_sides() -> None:
    found = seen()
    assert (found.left_m, found.right_m) == pytest.approx((5.25 - 0.925, 5.25 - 0.925))
    assert perceived_of(replace(labelled_scene(), drivable=())) is None


@pytest.mark.parametrize(
    ("other", "near_s"),
    [
        (agent(50.0, 0.0, speed=10.0), None),  # leads, and stays more than two seconds away
        (agent(22.0, 0.0, speed=10.0), 0.5),  # less
        (agent(50.0, 0.0), 3.0),  # stands, and is less than two seconds away from 2.6 s on
        (agent(30.0, 3.5, speed=10.0), None),  # beside
        (agent(40.0, -10.0, speed=4.0, heading=math.pi / 2, kind="pedestrian"), 2.0),  # walks into the way
        (agent(40.0, -10.0, speed=4.0, heading=-math.pi / 2, kind="pedestrian"), None),  # and away from it
    ],
)
def test_who_comes_into_the_safe_zone_when(other: Agent, near_s: float | None) -> None:
    [told] = seen(other).agents
    assert told.near_s == near_s


def test_who_is_absent_later_comes_no_nearer() -> None:
    other = agent(40.0, 0.0)
    poses = other.poses.copy()
    poses[20:] = np.nan
    [told] = seen(replace(other, poses=poses)).agents
    assert told.near_s is None


@given(
    st.lists(
        st.tuples(st.floats(-5, 60), st.floats(-10, 10), st.floats(0, 10), st.floats(-3, 3)), max_size=4
    ),
    st.floats(0, 15),
)
def test_a_mirrored_scene_is_perceived_mirrored(
    others: list[tuple[float, float, float, float]], speed: float
) -> None:
    labelled: LabelledScene = labelled_scene(
        speed, 0.1, agents=tuple(agent(x, y, v, heading) for x, y, v, heading in others)
    )
    perceived = perceived_of(labelled)
    assert perceived is not None
    theirs = perceived_of(mirrored_scene(labelled))
    assert theirs is not None
    np.testing.assert_allclose(theirs.row(), perceived.mirrored().row(), atol=1e-4)
