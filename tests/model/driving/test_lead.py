from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.lead import lead_within
from tests.model.driving.drives import MIDDLES_S, agent, labelled_scene


@pytest.mark.parametrize(
    ("x", "y", "kind", "expected"),
    [
        (22.0, 0.0, "vehicle", True),
        (22.2, 0.0, "vehicle", True),  # 2.255 m to the front bumper, 19.945 m beyond it
        (22.4, 0.0, "vehicle", False),
        (15.0, 1.7, "vehicle", True),
        (15.0, 3.5, "vehicle", False),
        (-8.0, 0.0, "vehicle", False),
        (2.0, 0.0, "vehicle", False),
        (15.0, 0.0, "pedestrian", False),
        (np.nan, 0.0, "vehicle", False),
    ],
)
def test_a_lead_is_a_vehicle_close_ahead_in_the_way(x: float, y: float, kind: str, expected: bool) -> None:
    other = agent(x, y, kind="pedestrian" if kind == "pedestrian" else "vehicle")
    assert lead_within(labelled_scene(10.0, agents=(other,))) is expected


def test_a_lead_around_the_bend_is_in_the_experts_way() -> None:
    # Radius 20 m: a quarter circle ends at (20, 20).
    around = agent(np.sin(0.8) * 20, (1 - np.cos(0.8)) * 20)
    assert lead_within(labelled_scene(8.0, 0.4, agents=(around,)))
    assert not lead_within(labelled_scene(8.0, agents=(around,)))


def test_a_lead_behind_which_the_expert_stops_is_in_its_way() -> None:
    # It turns by half a radian and stops; the vehicle stands where that heading leads to.
    turning = np.where(MIDDLES_S < 2, 0.25, 0.0)
    stopping = np.maximum(0, 4 - 2 * np.maximum(MIDDLES_S, 0))
    labelled = labelled_scene(stopping, turning)
    x, y, _, heading = labelled.future[-1].tolist()
    ahead = agent(x + 8 * np.cos(heading), y + 8 * np.sin(heading))
    assert ahead.present[1] > 2
    assert lead_within(replace(labelled, agents=(ahead,)))
