from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.agents import Agent
from looktwice.model.driving.facts import FACTS, facts_of, mirrored, scene_facts
from looktwice.model.driving.scene import EGO_LENGTH_M
from looktwice.model.driving.tracks import Track, tracks_of
from tests.model.driving.drives import agent, labelled_scene

ROUTE = np.stack([4.0 * np.arange(1, 21), 0.3 * np.arange(1, 21)], axis=1).astype(np.float32)


def fact(name: str, *agents: Agent) -> float:
    return float(scene_facts(labelled_scene(agents=agents))[FACTS.index(name)])


def test_an_empty_road_has_nobody_on_it() -> None:
    facts = dict(zip(FACTS, scene_facts(labelled_scene()), strict=True))
    assert all(value == 0 for name, value in facts.items() if name.endswith("present"))
    assert np.isnan(facts["own_0_gap_log_m"])
    assert all(facts[f"road_left_{distance}m"] == 0 for distance in range(8, 81, 8))


def test_leads_are_ranked_within_their_lanes() -> None:
    near, far = agent(20.0, 0.5, speed=4.0, agent_id=1), agent(40.0, 0.0, agent_id=2)
    left = agent(8.0, 3.5, speed=12.0, agent_id=3)
    gap = 20.0 - (EGO_LENGTH_M + near.length_m) / 2
    assert np.isclose(np.expm1(fact("own_0_gap_log_m", far, left, near)), gap, rtol=1e-4)
    assert fact("own_0_speed", far, left, near) == pytest.approx(0.4, rel=1e-3)
    assert fact("own_0_standing", far, left, near) == 0
    assert fact("own_1_standing", far, left, near) == 1
    assert fact("left_0_speed", far, left, near) == pytest.approx(1.2, rel=1e-3)
    assert fact("right_0_present", far, left, near) == 0


def test_what_has_to_be_driven_round_is_an_obstacle() -> None:
    stranded = replace(agent(50.0, -3.5, agent_id=1), lights=frozenset({"left", "right"}))
    cone = agent(30.0, 0.0, kind="cone", size_m=(0.5, 0.5, 0.8), agent_id=2)
    assert fact("right_0_fixed", stranded, cone) == 1
    assert fact("right_obstacle_present", stranded, cone) == 1
    gap = 30.0 - (EGO_LENGTH_M + 0.5) / 2
    assert np.isclose(np.expm1(fact("own_obstacle_gap_log_m", stranded, cone)), gap, rtol=1e-4)
    assert fact("own_obstacle_present", agent(30.0, 0.0)) == 0


def test_walkers_are_told_apart_from_vehicles() -> None:
    walker = agent(25.0, -5.0, speed=1.2, heading=np.pi / 2, kind="pedestrian", size_m=(0.6, 0.6, 1.8))
    assert fact("own_0_present", walker) == 0
    assert fact("walker_0_present", walker) == 1
    assert fact("walker_0_speed_left", walker) == pytest.approx(0.6, rel=1e-3)
    assert fact("walker_0_left", walker) < 0


def test_a_scene_without_a_route_has_no_facts() -> None:
    scene = labelled_scene()
    assert np.isnan(scene_facts(replace(scene, scene=replace(scene.scene, route=None)))).all()


def test_mirrored_facts_are_those_of_the_mirrored_scene() -> None:
    agents = (
        agent(20.0, 1.0, speed=4.0),
        agent(15.0, 5.0, speed=7.0),
        agent(30.0, -2.5, kind="cone", size_m=(0.5, 0.5, 0.8)),
        agent(25.0, 6.0, speed=1.0, heading=-1.5, kind="pedestrian", size_m=(0.6, 0.6, 1.8)),
    )
    tracks = tracks_of(agents)
    swapped = [replace(track, y_m=-track.y_m, heading_rad=-track.heading_rad) for track in tracks]
    expected = facts_of(swapped, (ROUTE * [1, -1]).astype(np.float32))
    np.testing.assert_allclose(mirrored(facts_of(tracks, ROUTE)), expected, atol=1e-5)


def test_lights_say_who_brakes() -> None:
    braking = Track(20.0, 0.0, 0.0, 5.0, 4.5, 1.9, "vehicle", frozenset({"brake"}))
    facts = dict(zip(FACTS, facts_of((braking,), ROUTE), strict=True))
    assert facts["own_0_braking"] == 1
    assert facts["own_0_fixed"] == 0
