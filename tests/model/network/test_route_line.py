"""Routes in batches are the same curved axes as one by one."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.route_frame import RouteFrame
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.network.route_line import RouteLine, interpolated

LENGTHS = 4.0 * np.arange(1, 21)
KNOWN = torch.ones(1, dtype=torch.bool)


def bend(radius_m: float) -> FloatArray:
    angle = LENGTHS / radius_m
    return np.stack([radius_m * np.sin(angle), radius_m * (1 - np.cos(angle))], axis=1).astype(np.float32)


def line_of(route: FloatArray) -> RouteLine:
    return RouteLine.of(torch.from_numpy(route)[None], KNOWN)


@given(st.sampled_from([-80.0, -35.0, 35.0, 1e4]), st.floats(-40, 120), st.floats(-12, 12))
def test_places_are_those_of_the_route_frame(radius_m: float, x: float, y: float) -> None:
    route = bend(radius_m)
    along, left, heading = line_of(route).places(torch.tensor([[[x, y]]]))
    frame, point = RouteFrame(route), np.array([[x, y]])
    where = np.array([[float(along), float(left)]])
    # At a corner both segments are as near.
    np.testing.assert_allclose(np.hypot(*(where - frame.places(point))[0]), 0, atol=0.5)
    if abs(float(left)) < 5:
        np.testing.assert_allclose(where, frame.places(point), atol=0.02)
        np.testing.assert_allclose(float(heading), frame.headings(point)[0], atol=0.2)


@given(st.sampled_from([-80.0, -35.0, 35.0, 1e4]), st.floats(2, 75), st.floats(-3, 3))
def test_a_point_so_far_along_and_left_is_found_there(radius_m: float, along_m: float, left_m: float) -> None:
    line = line_of(bend(radius_m))
    point = line.poses(torch.tensor([[along_m]]), torch.tensor([[left_m]]))
    along, left, _ = line.places(point)
    assert abs(float(along) - along_m) < 0.3
    assert abs(float(left) - left_m) < 0.1


def test_without_a_route_it_goes_straight_on() -> None:
    nowhere = torch.full((1, 20, 2), torch.nan)
    along, left, heading = RouteLine.of(nowhere, ~KNOWN).places(torch.tensor([[[30.0, -2.0]]]))
    assert (round(float(along), 4), round(float(left), 4), float(heading)) == (30.0, -2.0, 0.0)


@given(st.lists(st.floats(-20, 20), min_size=1, max_size=5))
def test_interpolation_is_numpys(wanted: list[float]) -> None:
    known, values = np.array([-3.0, 0.0, 0.0, 5.0]), np.array([1.0, 2.0, 4.0, -1.0])
    found = interpolated(
        torch.tensor([wanted]), torch.tensor(known)[None], torch.tensor(values)[None, :, None]
    )
    away = [at for at in wanted if abs(at) > 1e-3]
    np.testing.assert_allclose(
        found[0, [place for place, at in enumerate(wanted) if abs(at) > 1e-3], 0].numpy(),
        np.interp(away, known, values),
        atol=1e-6,
    )
