from __future__ import annotations

import numpy as np

from model.driving.scene import EGO_LENGTH_M
from model.training.facts import FACTS, lead_agent, scene_facts
from tests.model.driving.drives import agent, labelled_scene


def fact(name: str, *agents: object) -> float:
    return float(scene_facts(labelled_scene(agents=agents))[FACTS.index(name)])  # type: ignore[arg-type]


def test_an_empty_road_has_no_lead() -> None:
    assert fact("lead_present") == 0
    assert np.isnan(fact("lead_gap_log_m"))
    assert fact("agent_0_present") == 0


def test_the_nearest_agent_in_the_way_leads() -> None:
    near, far, beside = (
        agent(20.0, 0.5, agent_id=1),
        agent(40.0, 0.0, agent_id=2),
        agent(8.0, 3.5, agent_id=3),
    )
    scene = labelled_scene(agents=(far, beside, near))
    assert lead_agent(scene) is near
    gap = 20.0 - (EGO_LENGTH_M + near.length_m) / 2
    assert np.isclose(np.expm1(fact("lead_gap_log_m", far, beside, near)), gap, rtol=1e-4)


def test_agents_are_ranked_by_distance_and_left_is_positive() -> None:
    left, right = agent(15.0, 3.5, agent_id=1), agent(30.0, -3.5, agent_id=2)
    assert np.isclose(np.expm1(fact("agent_0_x_log_m", right, left)), 15.0, rtol=1e-4)
    assert fact("agent_0_left_over_x", right, left) > 0
    assert fact("agent_1_left_over_x", right, left) < 0
    assert fact("agent_2_present", right, left) == 0


def test_a_straight_route_lies_ahead() -> None:
    assert all(fact(f"route_left_{distance}m") == 0 for distance in range(8, 81, 8))
