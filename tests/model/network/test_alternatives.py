"""What else might be driven: in batches the same as one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.mends import mended
from looktwice.model.driving.route_frame import RouteFrame
from looktwice.model.driving.trajectory import POSE_MIRROR, FloatArray, constant_turn_rate, path_length
from looktwice.model.network.alternatives import ALTERNATIVES, PACES, alternatives
from looktwice.model.network.route_line import RouteLine
from tests.model.driving.test_mends import steady
from tests.model.network.test_route_line import bend

POSES = [0, 1, 3]


def others(trajectory: FloatArray, history: FloatArray, route: FloatArray) -> dict[str, FloatArray]:
    """The alternatives [64, 3] by name."""
    found = alternatives(
        torch.from_numpy(trajectory[None][..., POSES]),
        torch.from_numpy(history)[None],
        RouteLine.of(torch.from_numpy(route)[None], torch.ones(1, dtype=torch.bool)),
    )
    return dict(zip(ALTERNATIVES, found[0].numpy(), strict=True))


@given(st.floats(0.5, 25.0), st.floats(-0.2, 0.2))
def test_another_pace_is_that_of_the_mend(speed_ms: float, yaw_rate: float) -> None:
    history = steady(speed_ms, yaw_rate)
    trajectory = constant_turn_rate(history)
    found = others(trajectory, history, bend(60.0))
    for mend in PACES:
        expected = mended(mend, trajectory, trajectory, history)[:, POSES]
        np.testing.assert_allclose(found[mend], expected, atol=2e-2)


@pytest.mark.parametrize("radius_m", [-60.0, 60.0, 1e4])
def test_the_routes_way_leads_back_to_the_route_and_stays_there(radius_m: float) -> None:
    history, route = steady(10.0), bend(radius_m)
    route[:, 1] += 1.5
    found = others(constant_turn_rate(history), history, route)["the route's way"]
    left = RouteFrame(route).places(found[:, :2])[:, 1]
    assert left[0] == pytest.approx(-1.5, abs=0.25)
    np.testing.assert_allclose(left[25:], 0, atol=0.15)
    driven = np.concatenate([found[:, :2], np.zeros((64, 1)), found[:, 2:]], axis=1)
    assert path_length(driven) == pytest.approx(64, abs=0.5)


def test_the_routes_way_knows_no_left_and_right() -> None:
    history, route = steady(10.0, 0.05), bend(50.0)
    route[:, 1] -= 1.0
    trajectory = constant_turn_rate(history)
    one = others(trajectory, history, route)["the route's way"]
    mirror = others(trajectory * POSE_MIRROR, history * POSE_MIRROR, route * POSE_MIRROR[:2])
    np.testing.assert_allclose(mirror["the route's way"], one * np.array([1, -1, -1]), atol=1e-3)
