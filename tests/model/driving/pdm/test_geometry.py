"""Our geometry beside shapely's, on random shapes."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from looktwice.model.driving.pdm.geometry import (
    Boxes,
    Points,
    area_meets,
    beside_line,
    boxes_meet,
    crosses_itself,
    gaps,
    near,
    on_line,
    segments_meet,
    to_edges,
)
from looktwice.model.driving.pdm.world import Area, Array

SEEDS = range(8)


def star(dice: np.random.Generator, corners: int) -> Array:
    """A ring that does not cross itself."""
    angles = np.sort(dice.uniform(0, 2 * np.pi, corners))
    radii = dice.uniform(3, 20, corners)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1)


def some_boxes(dice: np.random.Generator, count: int) -> Boxes:
    x, y = dice.uniform(-20, 20, (2, count))
    heading = dice.uniform(-np.pi, np.pi, count)
    return Boxes.of(x, y, heading, dice.uniform(0.5, 8, count), dice.uniform(0.5, 3, count))


@pytest.mark.parametrize("seed", SEEDS)
def test_points_are_inside_where_shapely_says_so(seed: int) -> None:
    dice = np.random.default_rng(seed)
    outline, hole = star(dice, 12), 0.2 * star(dice, 5)
    points = dice.uniform(-20, 20, (400, 2))
    inside = Points(points).inside(Area((outline, hole)))
    parity = shapely.contains_xy(shapely.Polygon(outline), *points.T)
    parity ^= shapely.contains_xy(shapely.Polygon(hole), *points.T)
    assert (inside == parity).all()
    other = Area((outline + 5,))
    assert (
        Points(points).inside_any([Area((outline, hole)), other]) == parity | Points(points).inside(other)
    ).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_boxes_and_areas_meet_where_shapely_says_so(seed: int) -> None:
    dice = np.random.default_rng(seed)
    one, other = some_boxes(dice, 600), some_boxes(dice, 600)
    ours, theirs = shapely.polygons(one.corners()), shapely.polygons(other.corners())
    assert (boxes_meet(one, other) == shapely.intersects(ours, theirs)).all()
    assert gaps(one, other) == pytest.approx(shapely.distance(ours, theirs), abs=1e-9)
    ends = one.corners()[:, [0, 3]]
    lines = shapely.linestrings(ends)
    assert (segments_meet(ends[:, 0], ends[:, 1], other) == shapely.intersects(lines, theirs)).all()
    ring = star(dice, 15)
    assert (area_meets(Area((ring,)), one) == shapely.intersects(shapely.Polygon(ring), ours)).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_lines_are_as_far_as_shapely_says(seed: int) -> None:
    dice = np.random.default_rng(seed)
    line = np.cumsum(dice.uniform(-1, 3, (40, 2)), axis=0)
    points = dice.uniform(-5, 40, (300, 2))
    along, apart, _ = on_line(points, line)
    theirs, dots = shapely.LineString(line), shapely.points(points)
    assert apart == pytest.approx(shapely.distance(dots, theirs))
    assert along == pytest.approx(shapely.line_locate_point(theirs, dots))
    assert (beside_line(points, line, 2.5) == (shapely.distance(dots, theirs) > 2.5)).all()
    edges = np.hstack([line[:-1], line[1:]])
    assert to_edges(points, edges) == pytest.approx(apart)


def test_what_is_near_holds_all_that_meet() -> None:
    dice = np.random.default_rng(3)
    x, y, heading = dice.uniform(-15, 15, (3, 20, 9))
    ego = Boxes.of(x, y, heading, np.full((20, 9), 5.0), np.full((20, 9), 2.0))
    a, b, c = dice.uniform(-15, 15, (3, 9, 6))
    a[2, 4] = np.nan
    others = Boxes.of(a, b, c, np.full(6, 4.0), np.full(6, 2.0))
    found = set(zip(*(each.tolist() for each in near(ego, others)), strict=True))
    for plan in range(20):
        for step in range(9):
            for other in range(6):
                if boxes_meet(ego[plan, step], others[step, other]):
                    assert (plan, step, other) in found
    assert not any(step == 2 and other == 4 for _, step, other in found)


@pytest.mark.parametrize("seed", range(60))
def test_rings_cross_themselves_where_shapely_says_so(seed: int) -> None:
    dice = np.random.default_rng(seed)
    ring = star(dice, 9) if seed % 3 else dice.uniform(-5, 5, (5, 2))
    assert crosses_itself(ring) == (not shapely.LinearRing(ring).is_simple)
