from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from looktwice.clients.alpasim.route import route_ahead


def straight(begins_m: float, ends_m: float, apart_m: float = 2.0) -> npt.NDArray[np.float64]:
    along_m = np.arange(begins_m, ends_m + 1e-9, apart_m)
    return np.stack([along_m, np.full_like(along_m, 1.5)], axis=1)


def test_points_lie_every_four_metres_from_beside_the_ego() -> None:
    route = route_ahead(straight(-31.0, 120.0))
    assert route is not None
    np.testing.assert_allclose(route[:, 0], 4.0 * np.arange(1, 21), atol=1e-5)
    np.testing.assert_allclose(route[:, 1], 1.5)


def test_a_bend_keeps_its_length() -> None:
    turn = np.linspace(0, np.pi / 2, 200)
    arc = 60.0 * np.stack([np.sin(turn), 1 - np.cos(turn)], axis=1)
    route = route_ahead(arc)
    assert route is not None
    np.testing.assert_allclose(np.hypot(*np.diff(route, axis=0).T), 4.0, atol=0.01)
    np.testing.assert_allclose(np.hypot(route[:, 0], route[:, 1] - 60.0), 60.0, atol=0.01)


def test_what_alpasim_fills_up_with_nan_ends_there_and_goes_straight_on() -> None:
    points = straight(0.0, 40.0, 4.0)
    points[8:] = np.nan
    route = route_ahead(points)
    assert route is not None
    np.testing.assert_allclose(route[:, 0], 4.0 * np.arange(1, 21), atol=1e-5)


def test_a_route_that_begins_ahead_is_led_back_to_the_ego() -> None:
    points = straight(10.0, 120.0)
    points[:, 1] = 0.0
    route = route_ahead(points)
    assert route is not None
    np.testing.assert_allclose(route[:, 0], 4.0 * np.arange(1, 21), atol=1e-5)


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 2)), np.zeros((5, 2)), np.full((20, 2), np.nan), straight(-80.0, 0.0), straight(0.0, 6.0)],
)
def test_there_is_no_way_to_go(points: npt.NDArray[np.float64]) -> None:
    assert route_ahead(points) is None
