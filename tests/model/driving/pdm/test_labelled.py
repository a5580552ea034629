"""Scenes of our own as worlds to score in."""

from __future__ import annotations

import numpy as np
import pytest

from model.bundled import SCENES
from model.driving.pdm.comfort import _filter
from model.driving.pdm.failures import failures_of
from model.driving.pdm.labelled import EGO, plans_of, world_of
from model.driving.pdm.scoring import COLLISIONS, DRIVABLE, Others, score
from model.driving.pdm.world import HEADING, SPEED
from model.driving.scene_store import read_scenes


def test_experts_of_bundled_scenes_hit_nothing_and_stay_on_the_road() -> None:
    for labelled in read_scenes(SCENES, dense=False):
        world = world_of(labelled)
        expert = plans_of(labelled.future)
        found = score(world, expert[None], "v1.1", Others(reference=expert, against="expert"), centre=True)
        for name in (COLLISIONS, DRIVABLE):
            value = found.sub_scores[name]
            assert value is not None
            assert value.tolist() == [1.0], (labelled.scene.scene_id, failures_of(world, found))
        # The tracker follows the expert from its own speed: where it was driven, there it ends.
        axle = expert[39, :2] - EGO.centre_m * np.array([np.cos(expert[39, 2]), np.sin(expert[39, 2])])
        assert found.states[0, 40, :2] == pytest.approx(axle, abs=3.0)
        assert world.ego[SPEED] == pytest.approx(float(-labelled.scene.history[-2, 0]) / 0.1, abs=0.5)
        assert abs(world.ego[HEADING]) < 1e-3


def test_the_smoothing_is_scipys() -> None:
    signal = pytest.importorskip("scipy.signal")
    dice = np.random.default_rng(0)
    for count, window, order, derivative in ((41, 8, 2, 0), (55, 15, 2, 1), (41, 41, 2, 1), (36, 5, 3, 2)):
        values = dice.normal(size=(3, count))
        expected = signal.savgol_filter(values, window, order, deriv=derivative, delta=0.1)
        assert values @ _filter(count, window, order, derivative).T == pytest.approx(expected, abs=1e-9)
