from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely import Point, Polygon

from looktwice.model.driving.metrics import (
    box_corners,
    collides,
    corner_distances,
    displacement_errors,
    leaves_road,
    points_inside,
)
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, Agent
from looktwice.model.driving.trajectory import FloatArray
from tests.model.driving.drives import agent, drive, rectangle


def random_draws(seed: int, n: int = 4) -> tuple[FloatArray, FloatArray]:
    """Draws [n, 64, 4] and an expert: curved drives, some close to each other."""
    random = np.random.default_rng(seed)
    paths = [drive(random.uniform(-2, 12), random.uniform(-0.4, 0.4))[0] for _ in range(n + 1)]
    return np.stack(paths[:n]), paths[n]


def slow_corners(
    x: float, y: float, heading: float, length: float, width: float
) -> list[tuple[float, float]]:
    corners = []
    for ahead, left in ((1, 1), (1, -1), (-1, -1), (-1, 1)):
        dx, dy = ahead * length / 2, left * width / 2
        corners.append(
            (
                x + dx * math.cos(heading) - dy * math.sin(heading),
                y + dx * math.sin(heading) + dy * math.cos(heading),
            )
        )
    return corners


def slow_ego_box(pose: NDArray[np.float32]) -> list[tuple[float, float]]:
    return slow_corners(float(pose[0]), float(pose[1]), float(pose[3]), EGO_LENGTH_M, EGO_WIDTH_M)


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_displacement_errors_equal_the_slow_ones(seed: int) -> None:
    draws, expert = random_draws(seed)
    ade, fde, corner = [], [], []
    for draw in draws:
        apart = [math.dist(one[:2], other[:2]) for one, other in zip(draw, expert, strict=True)]
        ade.append(sum(apart) / 64)
        fde.append(apart[63])
        corner.append(
            sum(
                math.dist(a, b)
                for one, other in zip(draw, expert, strict=True)
                for a, b in zip(slow_ego_box(one), slow_ego_box(other), strict=True)
            )
            / (64 * 4)
        )
    errors = displacement_errors(draws, expert)
    assert errors.min_ade_m == pytest.approx(min(ade), rel=1e-5)
    assert errors.avg_ade_m == pytest.approx(sum(ade) / len(ade), rel=1e-5)
    assert errors.min_fde_m == pytest.approx(min(fde), rel=1e-5)
    assert errors.avg_fde_m == pytest.approx(sum(fde) / len(fde), rel=1e-5)
    assert errors.corner_distance_m == pytest.approx(min(corner), rel=1e-5)
    np.testing.assert_allclose(corner_distances(draws, expert), corner, rtol=1e-5)


def test_the_expert_itself_has_no_error_and_a_shift_has_its_length() -> None:
    _, expert = random_draws(5)
    assert displacement_errors(expert[None], expert).min_ade_m == 0.0
    shifted = expert + np.array([3, 4, 0, 0], np.float32)
    errors = displacement_errors(shifted[None], expert)
    assert errors.avg_ade_m == pytest.approx(5, abs=1e-5)
    assert errors.corner_distance_m == pytest.approx(5, abs=1e-5)


def test_height_counts_for_nothing() -> None:
    _, expert = random_draws(6)
    assert displacement_errors((expert + np.array([0, 0, 9, 0], np.float32))[None], expert).avg_fde_m == 0.0


def test_box_corners_equal_the_slow_ones() -> None:
    poses = np.random.default_rng(2).uniform(-9, 9, (7, 3))
    for pose, corners in zip(poses, box_corners(poses, 4.0, 2.0), strict=True):
        np.testing.assert_allclose(
            corners, np.array(slow_corners(pose[0], pose[1], pose[2], 4.0, 2.0)), atol=1e-9
        )


# Collisions


def slow_collides(trajectory: FloatArray, agents: list[Agent], within_s: float) -> bool:
    for step in range(round(within_s * 10)):
        ego = Polygon(slow_ego_box(trajectory[step]))
        for other in agents:
            x, y, heading = (float(value) for value in other.future[step])
            if math.isnan(x):
                continue
            if ego.intersects(Polygon(slow_corners(x, y, heading, other.length_m, other.width_m))):
                return True
    return False


@given(st.integers(0, 100_000), st.sampled_from([1.0, 5.0, 6.4]))
@settings(max_examples=60, deadline=None)
def test_collisions_equal_the_slow_ones(seed: int, within_s: float) -> None:
    random = np.random.default_rng(seed)
    draws, _ = random_draws(seed, n=3)
    agents = []
    for _ in range(random.integers(0, 4)):
        other = agent(
            x=random.uniform(-5, 45),
            y=random.uniform(-12, 12),
            speed=random.uniform(0, 12),
            heading=random.uniform(-4, 4),
            size_m=(random.uniform(0.4, 9), random.uniform(0.4, 2.6), 1.5),
        )
        absent = np.zeros(80, np.bool_)
        absent[random.integers(0, 80) :] = random.random() < 0.5
        poses = np.where(absent[:, None], np.nan, other.poses).astype(np.float32)
        agents.append(Agent(1, "vehicle", other.length_m, other.width_m, 1.5, poses))
    expected = [slow_collides(draw, agents, within_s) for draw in draws]
    assert collides(draws, agents, within_s).tolist() == expected


def test_a_crash_after_five_seconds_does_not_count() -> None:
    # Bumpers meet after x - 4.5 m, at 10 m/s: just before and just after 5.0 s.
    future, _ = drive(10.0)
    near = agent(x=54.0, y=0.0)
    far = agent(x=54.6, y=0.0)
    assert collides(future[None], [near]).tolist() == [True]
    assert collides(future[None], [far]).tolist() == [False]
    assert collides(future[None], [far], within_s=6.4).tolist() == [True]


def test_boxes_that_only_circles_would_touch_do_not_collide() -> None:
    future, _ = drive(0.0)
    diagonal = agent(x=3.5, y=2.2, heading=-math.pi / 4, size_m=(3.0, 0.5, 1.0))
    beside = agent(x=0.0, y=1.9, size_m=(4.0, 1.8, 1.5))
    touching = agent(x=0.0, y=1.8, size_m=(4.0, 1.8, 1.5))
    assert collides(future[None], [diagonal]).tolist() == [False]
    assert collides(future[None], [beside]).tolist() == [False]
    assert collides(future[None], [touching]).tolist() == [True]


def test_corners_that_barely_overlap_collide() -> None:
    # Both stand; the boxes share a few centimetres at a corner, their centres are far apart.
    future, _ = drive(0.0)
    at_the_corner = agent(x=EGO_LENGTH_M / 2 + 2.15, y=EGO_WIDTH_M / 2 + 0.85)
    assert collides(future[None], [at_the_corner]).tolist() == [True]


def test_nobody_there_is_no_collision() -> None:
    future, _ = drive(5.0)
    absent = Agent(1, "vehicle", 4, 2, 1.5, np.full((80, 3), np.nan, np.float32))
    assert collides(future[None], []).tolist() == [False]
    assert collides(future[None], [absent]).tolist() == [False]


# The road


@given(st.integers(0, 100_000))
@settings(max_examples=40, deadline=None)
def test_points_inside_a_polygon_with_a_hole_equal_shapelys(seed: int) -> None:
    random = np.random.default_rng(seed)
    angle = np.sort(random.uniform(0, 2 * np.pi, 12))
    radius = random.uniform(4, 10, 12)
    outer = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1).astype(np.float32)
    hole = rectangle(-1, -1, 1.5, 1)
    other = rectangle(20, 0, 25, 5)  # a second piece of road
    points = np.concatenate([random.uniform(-11, 11, (150, 2)), random.uniform([18, -2], [27, 7], (50, 2))])
    expected = [
        (Polygon(outer).contains(Point(p)) != Polygon(hole).contains(Point(p)))
        or Polygon(other).contains(Point(p))
        for p in points
    ]
    assert points_inside(points, [outer, hole, other]).tolist() == expected


@given(st.integers(0, 100_000))
@settings(max_examples=30, deadline=None)
def test_leaving_the_road_equals_the_slow_way(seed: int) -> None:
    random = np.random.default_rng(seed)
    draws, _ = random_draws(seed)
    road = rectangle(-40, -random.uniform(1, 30), 90, random.uniform(1, 30))
    polygon = Polygon(road)
    expected = [not all(polygon.contains(Polygon(slow_ego_box(pose))) for pose in draw) for draw in draws]
    assert leaves_road(draws, [road]).tolist() == expected


def test_one_wheel_on_the_grass_leaves_the_road() -> None:
    future, _ = drive(8.0)
    half = EGO_WIDTH_M / 2
    assert leaves_road(future[None], [rectangle(-10, -half - 0.01, 90, 3)]).tolist() == [False]
    assert leaves_road(future[None], [rectangle(-10, -half + 0.01, 90, 3)]).tolist() == [True]
    assert leaves_road(future[None], []).tolist() == [True]
