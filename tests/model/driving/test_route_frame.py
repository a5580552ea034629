from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.route_frame import RouteFrame
from looktwice.model.driving.trajectory import FloatArray

LENGTHS = 4.0 * np.arange(1, 21)


def arc(radius_m: float) -> FloatArray:
    """A route that turns left around (0, radius), or right where it is negative."""
    angle = LENGTHS / radius_m
    return np.stack([radius_m * np.sin(angle), radius_m * (1 - np.cos(angle))], axis=1).astype(np.float32)


def straight(left_m: float = 0.0) -> FloatArray:
    return np.stack([LENGTHS, np.full(20, left_m)], axis=1).astype(np.float32)


@given(st.floats(-60, 140), st.floats(-30, 30), st.floats(-3, 3))
def test_beside_a_straight_route_places_are_plain_differences(x: float, y: float, left: float) -> None:
    frame = RouteFrame(straight(left))
    along, beside = frame.places(np.array([[x, y]]))[0]
    assert along == pytest.approx(x, abs=1e-4)
    assert beside == pytest.approx(y - left, abs=1e-4)


@given(st.floats(6, 78), st.floats(-4, 4), st.sampled_from([-90.0, -40.0, 40.0, 90.0]))
def test_on_an_arc_places_follow_the_curve(along: float, left: float, radius: float) -> None:
    angle = along / radius
    centre = np.array([0.0, radius])
    point = centre + (radius - left) * np.array([np.sin(angle), -np.cos(angle)])
    frame = RouteFrame(arc(radius))
    found = frame.places(point[None])[0]
    # The chord of 4 m stands off the arc by up to 5 cm, and its ends meet at an angle.
    assert found[1] == pytest.approx(left, abs=0.15)
    assert found[0] == pytest.approx(along, abs=0.5)
    assert frame.headings(point[None])[0] == pytest.approx(angle, abs=6.5 / abs(radius))


def test_the_ego_is_at_zero_even_beside_its_lane() -> None:
    assert RouteFrame(straight(3.0)).places(np.zeros((1, 2)))[0, 0] == pytest.approx(0.0)
    assert RouteFrame(arc(50.0)).places(np.zeros((1, 2)))[0, 0] == pytest.approx(0.0)
