"""Facts about a scene that its latest pictures show: targets for grounding the vision tower.

A vision-language model comes with such knowledge; a tower trained from scratch must learn it first.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from model.driving.scene import EGO_LENGTH_M, Agent, LabelledScene
from model.driving.trajectory import HISTORY_STEPS, STEP_S, FloatArray, present_speed

PATH_HALF_WIDTH_M: Final = 1.75
"""Half a lane: an agent whose centre is closer to the way ahead stands in it."""
FACT_RANGE_M: Final = 80.0
NEAREST: Final = 3
"""How many of the nearest agents ahead are asked for."""

FACTS: Final = (
    "lead_present",
    "lead_gap_log_m",
    "lead_speed_ms",
    *(f"route_left_{distance}m" for distance in range(8, 81, 8)),
    *(f"agent_{rank}_{what}" for rank in range(NEAREST) for what in ("present", "x_log_m", "left_over_x")),
)


def scene_facts(labelled: LabelledScene) -> FloatArray:
    """float32 [len(FACTS)]: the facts of one scene; NaN where a fact does not apply.

    Lengths are logarithms (an error of one metre matters more nearby), the lead's speed is relative to the
    ego's, and route points are metres to the left divided by 10.
    """
    facts = dict.fromkeys(FACTS, float("nan"))
    lead = lead_agent(labelled)
    facts["lead_present"] = float(lead is not None)
    if lead is not None:
        facts["lead_gap_log_m"] = np.log1p(max(0.0, _gap(lead)))
        facts["lead_speed_ms"] = (_speed(lead) - present_speed(labelled.scene.history)) / 10
    if labelled.scene.route is not None:
        for index, distance in enumerate(range(8, 81, 8)):
            facts[f"route_left_{distance}m"] = float(labelled.scene.route[2 * index + 1, 1]) / 10
    for rank in range(NEAREST):
        facts[f"agent_{rank}_present"] = 0.0
    for rank, agent in enumerate(_nearest_ahead(labelled)):
        x, left = float(agent.present[0]), float(agent.present[1])
        facts[f"agent_{rank}_present"] = 1.0
        facts[f"agent_{rank}_x_log_m"] = np.log1p(x)
        facts[f"agent_{rank}_left_over_x"] = left / (x + 1)
    return np.array([facts[name] for name in FACTS], np.float32)


def lead_agent(labelled: LabelledScene) -> Agent | None:
    """The nearest agent standing in the way ahead (the route, or straight on without one)."""
    way = labelled.scene.route
    if way is None:
        way = np.stack([np.arange(4.0, 84.0, 4.0), np.zeros(20)], axis=1).astype(np.float32)
    leads = [
        agent
        for agent in labelled.agents
        if np.isfinite(agent.present[0])
        and 0 < agent.present[0] < FACT_RANGE_M
        and np.linalg.norm(way - agent.present[:2], axis=1).min()
        < np.hypot(PATH_HALF_WIDTH_M, 2.0)  # points lie 4 m apart
    ]
    return min(leads, key=_gap, default=None)


def _gap(agent: Agent) -> float:
    return float(agent.present[0]) - (EGO_LENGTH_M + agent.length_m) / 2


def _speed(agent: Agent) -> float:
    """Speed over the last 0.5 s, in the ego frame of now, m/s; along x."""
    before = agent.poses[HISTORY_STEPS - 6]
    if not np.isfinite(before[0]):
        return float("nan")
    return float(agent.present[0] - before[0]) / (5 * STEP_S)


def _nearest_ahead(labelled: LabelledScene) -> list[Agent]:
    ahead = [
        agent
        for agent in labelled.agents
        if np.isfinite(agent.present[0])
        and 1.0 < agent.present[0] < FACT_RANGE_M
        and abs(agent.present[1]) < 1.7 * agent.present[0]  # within the wide camera's 120 degrees
    ]
    return sorted(ahead, key=lambda agent: float(np.hypot(*agent.present[:2])))[:NEAREST]
