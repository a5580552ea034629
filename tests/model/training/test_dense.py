from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.scene import FRONT_WIDE, SEMANTIC_CLASSES, DenseTarget
from looktwice.model.training.dense import DENSE_SHAPE, UNLABELLED, coarse, no_target, relative_motion
from tests.model.driving.drives import agent, labelled_scene


def test_coarse_cells_are_the_nearest_ones() -> None:
    classes = np.repeat(np.repeat(np.arange(6, dtype=np.uint8).reshape(2, 3), 28, 0), 37, 1)
    target = coarse(DenseTarget(FRONT_WIDE, classes, classes.astype(np.float32)))
    assert target.classes.shape == DENSE_SHAPE
    assert [int(target.classes[r, c]) for r in (0, 23) for c in (0, 24, 47)] == [0, 1, 2, 3, 4, 5]
    np.testing.assert_array_equal(target.range_m, target.classes)


def test_a_cell_that_shows_a_car_moves_as_the_car_does_against_the_ego() -> None:
    car = agent(20.0, 2.0, speed=4.0, heading=0.1)
    labelled = labelled_scene(speed=10.0, agents=(car,))
    classes = np.zeros(DENSE_SHAPE, np.uint8)
    ranges = np.zeros(DENSE_SHAPE, np.float32)
    spec = CAMERA_SPECS[FRONT_WIDE]
    column, row, depth = spec.project(np.array([[18.0, 2.0, 0.8]]))[0]
    cell = int(row / spec.height * DENSE_SHAPE[0]), int(column / spec.width * DENSE_SHAPE[1])
    classes[cell], ranges[cell] = SEMANTIC_CLASSES.index("vehicle"), depth
    motion = relative_motion(DenseTarget(FRONT_WIDE, classes, ranges), labelled)
    assert motion[0][cell] == pytest.approx((4.0 * np.cos(0.1) - 10.0) / 10, abs=0.02)
    assert motion[1][cell] == pytest.approx(4.0 * np.sin(0.1) / 10, abs=0.02)
    motion[(slice(None), *cell)] = 0
    assert not motion.any()


def test_nothing_is_known_of_pictures_without_targets() -> None:
    target = no_target(FRONT_WIDE)
    assert (target.classes == UNLABELLED).all()
    assert not relative_motion(target, replace(labelled_scene(), dense=())).any()
