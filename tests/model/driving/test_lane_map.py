from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from looktwice.model.driving.agents import SceneError
from looktwice.model.driving.lane_map import LaneArea, LaneMap, to_the_centimetre
from tests.model.driving.drives import rectangle

LINE = np.array([[-20.0, 0.0], [160.0, 0.0]])


@given(arrays(np.float64, (5, 2), elements=st.floats(-1e4, 1e4)))
def test_points_move_by_half_a_centimetre_at_most_and_only_once(points: np.ndarray) -> None:
    rounded = to_the_centimetre(points, 3, "a ring")
    assert np.abs(rounded - points).max() <= 0.005 + 1e-3  # a float32 is off by that much at 10 km
    assert np.array_equal(to_the_centimetre(rounded, 3, "a ring"), rounded)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((2, 2)), r"lane 7 needs at least 3 points \[k, 2\], got \[2, 2\]"),
        (np.zeros((4, 3)), r"got \[4, 3\]"),
        (np.array([[0.0, 0.0], [1.0, np.nan], [1.0, 1.0]]), "not finite"),
        (np.array([[0.0, 0.0], [1.0, 3e7], [1.0, 1.0]]), "too far away"),
    ],
)
def test_what_is_no_outline_says_so(points: np.ndarray, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        LaneArea(7, points.astype(np.float32), True)


def test_every_part_of_a_map_is_checked() -> None:
    lane = LaneArea(1, rectangle(0, 0, 10, 3), True)
    with pytest.raises(SceneError, match="an intersection needs at least 3"):
        LaneMap((lane,), (LINE,), LINE, has_lights=False)
    with pytest.raises(SceneError, match="the centre line needs at least 2"):
        LaneMap((lane,), (), LINE[:1], has_lights=False)
