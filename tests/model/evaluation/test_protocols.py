from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.evaluation.protocols import (
    CELLS,
    Array,
    BoolArray,
    Protocol,
    ProtocolError,
    collisions,
    occupied_cells,
    st_p3,
    uniad,
)
from tests.model.driving.drives import agent

EMPTY = np.zeros((1, 6, CELLS, CELLS), np.bool_)
STILL = np.zeros((1, 6, 2))
BOTH: tuple[Protocol, ...] = ("ST-P3", "UniAD")


def at(ahead_m: float, left_m: float) -> Array:
    """Six waypoints at one place."""
    return np.broadcast_to([ahead_m, left_m], (1, 6, 2)).astype(np.float64)


def one_cell(row: int, column: int) -> BoolArray:
    """Everything is free but one cell, at all times."""
    cells = EMPTY.copy()
    cells[:, :, row, column] = True
    return cells


def test_errors_up_to_a_time_and_at_it() -> None:
    apart_m = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    waypoints = np.stack([3 * apart_m / 5, 4 * apart_m / 5], -1)[None]
    assert uniad(waypoints, STILL, EMPTY).l2_m == pytest.approx((2.0, 4.0, 6.0))
    assert uniad(waypoints, STILL, EMPTY).average_l2_m == pytest.approx(4.0)
    assert st_p3(waypoints, STILL, EMPTY).l2_m == pytest.approx((1.5, 2.5, 3.5))
    assert st_p3(waypoints, STILL, EMPTY).average_l2_m == pytest.approx(2.5)


def test_a_collision_between_the_told_times_is_lost_to_uniad() -> None:
    """Two scenes; in the first a cell under the ego is occupied at 1.5 s alone."""
    cells = np.repeat(EMPTY, 2, axis=0)
    cells[0, 2, 100, 100] = True
    waypoints, experts = np.repeat(STILL, 2, axis=0), np.repeat(at(20, 0), 2, axis=0)
    assert uniad(waypoints, experts, cells).collision_rate == (0.0, 0.0, 0.0)
    told = st_p3(waypoints, experts, cells)
    assert told.collision_rate == pytest.approx((0.0, 0.5 / 4, 0.5 / 6))
    assert told.average_collision_rate == pytest.approx((0.125 + 0.5 / 6) / 3)


@pytest.mark.parametrize("protocol", BOTH)
def test_where_the_expert_is_hit_there_is_no_collision(protocol: Protocol) -> None:
    cells = EMPTY.copy()
    cells[:, :3, 100, 100] = True
    experts = STILL.copy()
    experts[:, 1] = [20, 0]
    hit = collisions(protocol, STILL, experts, cells)
    assert hit.tolist() == [[False, True, False, False, False, False]]
    figures = {"ST-P3": st_p3, "UniAD": uniad}[protocol](STILL, experts, cells)
    # The waypoints that do not count stay in the mean.
    assert figures.collision_rate[0] == (0.5 if protocol == "ST-P3" else 1.0)


@pytest.mark.parametrize("protocol", BOTH)
@pytest.mark.parametrize(
    ("row", "column", "hit"),
    [
        # The ego's box: 4.084 m long, half a metre ahead, covers the centres from -1.25 m to 2.25 m.
        (97, 100, True),
        (96, 100, False),
        (104, 100, True),
        (105, 100, False),
        # 1.85 m wide: the centres up to 0.75 m to either side.
        (100, 98, True),
        (100, 97, False),
        (100, 101, True),
        (100, 102, False),
    ],
)
def test_the_egos_box(protocol: Protocol, row: int, column: int, hit: bool) -> None:
    assert collisions(protocol, STILL, at(30, 0), one_cell(row, column)).all() == hit


@pytest.mark.parametrize(
    ("left_m", "column", "st_p3_hits", "uniad_hits"),
    [
        # 0.1 m to the right: ST-P3's box is a whole cell farther to the right, UniAD's where it was.
        (-0.1, 102, True, False),
        (-0.1, 98, False, True),
        # 0.1 m to the left it is the other way round.
        (0.1, 97, False, True),
        (0.1, 101, True, False),
        # On whole cells they agree.
        (-0.5, 102, True, True),
        (0.5, 97, True, True),
    ],
)
def test_lateral_rounding_goes_to_opposite_sides(
    left_m: float, column: int, st_p3_hits: bool, uniad_hits: bool
) -> None:
    cells = one_cell(100, column)
    assert collisions("ST-P3", at(0, left_m), at(30, 0), cells).all() == st_p3_hits
    assert collisions("UniAD", at(0, left_m), at(30, 0), cells).all() == uniad_hits


@pytest.mark.parametrize("protocol", BOTH)
def test_forward_rounding_goes_back(protocol: Protocol) -> None:
    assert collisions(protocol, at(0.4, 0), at(30, 0), one_cell(97, 100)).all()
    assert not collisions(protocol, at(0.4, 0), at(30, 0), one_cell(105, 100)).any()
    assert collisions(protocol, at(0.5, 0), at(30, 0), one_cell(105, 100)).all()


@pytest.mark.parametrize("protocol", BOTH)
def test_what_leaves_the_grid_is_at_its_border(protocol: Protocol) -> None:
    assert collisions(protocol, at(80, 0), STILL, one_cell(199, 100)).all()
    assert collisions(protocol, at(0, 80), STILL, one_cell(100, 0)).all()
    assert collisions(protocol, at(0, -80), STILL, one_cell(100, 199)).all()


def test_objects() -> None:
    car, walker, cone = agent(10, 5), agent(20, 0, kind="pedestrian"), agent(-10, 0, kind="cone")
    for protocol, kinds in (("ST-P3", [True, True, False]), ("UniAD", [True, False, False])):
        cells = occupied_cells("ST-P3" if protocol == "ST-P3" else "UniAD", [car, walker, cone])
        assert cells.shape == (6, CELLS, CELLS)
        # 10 m ahead is row 120, 5 m to the left is column 90.
        assert [cells[:, row, column].all() for row, column in ((120, 90), (140, 100), (80, 100))] == kinds


def test_boxes_are_rounded_to_cells_with_their_edges() -> None:
    """4.4 m x 1.8 m at the origin: corners at rows 96 and 104, columns 98 and 102, all of them included."""
    [first, *_] = occupied_cells("UniAD", [agent(0, 0)])
    rows, columns = np.nonzero(first)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (96, 104, 98, 102)
    assert first.sum() == 9 * 5


def test_objects_move_and_may_be_absent() -> None:
    moving = agent(0, 0, speed=10.0)
    moving.poses[16 + 29] = np.nan
    cells = occupied_cells("UniAD", [moving])
    assert [bool(grid.any()) for grid in cells] == [True] * 5 + [False]
    # 5 m after half a second, 25 m after 2.5 s.
    assert cells[0, 110, 100]
    assert cells[4, 150, 100]
    turned = occupied_cells("UniAD", [agent(0, 0, heading=np.pi / 2)])[0]
    rows, columns = np.nonzero(turned)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (98, 102, 96, 104)


@given(seed=st.integers(0, 20))
def test_they_agree_where_waypoints_lie_on_whole_cells(seed: int) -> None:
    random = np.random.default_rng(seed)
    waypoints = random.integers(-40, 40, (3, 6, 2)) / 2
    cells = random.random((3, 6, CELLS, CELLS)) < 0.01
    far = np.full((3, 6, 2), 40.0)
    one, other = (collisions(protocol, waypoints, far, cells) for protocol in BOTH)
    np.testing.assert_array_equal(one, other)


def test_bad_arrays_are_refused() -> None:
    with pytest.raises(ProtocolError, match=r"waypoints must have shape \[1, 6, 2\]"):
        uniad(np.zeros((1, 64, 2)), STILL, EMPTY)
    with pytest.raises(ProtocolError, match="occupied"):
        st_p3(STILL, STILL, EMPTY[:, :5])
    with pytest.raises(ProtocolError, match="not finite"):
        st_p3(STILL, STILL * np.nan, EMPTY)
    with pytest.raises(ProtocolError, match="no scenes"):
        st_p3(STILL[:0], STILL[:0], EMPTY[:0])
