"""Scenes of our own as worlds to score in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.bundled import SCENES
from looktwice.model.driving.lane_map import LaneArea, LaneMap
from looktwice.model.driving.pdm.comfort import _filter
from looktwice.model.driving.pdm.failures import failures_of
from looktwice.model.driving.pdm.labelled import EGO, plans_of, world_of
from looktwice.model.driving.pdm.scoring import (
    COLLISIONS,
    COMFORT,
    DIRECTION,
    DRIVABLE,
    EXTENDED_COMFORT,
    LANE_KEEPING,
    LIGHTS,
    PROGRESS,
    TIME_TO_COLLISION,
    Others,
    Scores,
    score,
)
from looktwice.model.driving.pdm.world import ACCELERATION, HEADING, SPEED, STEERING, YAW_RATE
from looktwice.model.driving.scene_store import read_scenes
from tests.model.driving.drives import MIDDLES_S, labelled_scene, rectangle


def test_experts_of_bundled_scenes_hit_nothing_and_stay_on_the_road() -> None:
    for labelled in read_scenes(SCENES, dense=False):
        world = world_of(labelled)
        expert = plans_of(labelled.future)
        found = score(world, expert[None], "v1.1", Others(reference=expert, against="expert"), centre=True)
        later = score(world, expert[None], "v2.2", Others(reference=expert, against="expert"), centre=True)
        assert later.missing == (EXTENDED_COMFORT,), labelled.scene.scene_id
        for name in (COLLISIONS, DRIVABLE):
            value = found.sub_scores[name]
            assert value is not None
            assert value.tolist() == [1.0], (labelled.scene.scene_id, failures_of(world, found))
        # The tracker follows the expert from its own speed: where it was driven, there it ends.
        assert found.states[0, 40, :2] == pytest.approx(expert[39, :2], abs=3.0)
        assert world.ego[SPEED] == pytest.approx(float(-labelled.scene.history[-2, 0]) / 0.1, abs=0.5)
        assert abs(world.ego[HEADING]) < 1e-3


def test_the_present_state_is_that_of_a_steady_drive() -> None:
    braking = world_of(labelled_scene(10.0 - 3.0 * MIDDLES_S))
    assert braking.ego[SPEED] == pytest.approx(10.0, abs=0.01)
    assert braking.ego[ACCELERATION] == pytest.approx(-3.0, abs=0.01)
    assert braking.past is not None
    assert braking.past[:, ACCELERATION] == pytest.approx(np.full(15, -3.0), abs=0.01)
    turning = world_of(labelled_scene(5.0, 0.5))
    assert turning.ego[YAW_RATE] == pytest.approx(0.5, abs=1e-3)
    assert turning.ego[STEERING] == pytest.approx(np.arctan(0.5 / 5.0 * EGO.wheelbase_m), abs=1e-3)


def test_the_tracker_stays_on_an_experts_circle() -> None:
    """The expert heads where its middle goes; put anywhere else, the tracker's fixed point would slip."""
    labelled = labelled_scene(5.0, 0.5)
    expert = plans_of(labelled.future)
    found = score(world_of(labelled), expert[None], "v1.1", centre=True)
    off = np.hypot(found.states[0, :, 0], found.states[0, :, 1] - 10.0) - 10.0
    assert np.abs(off).max() < 0.3


def test_a_lane_map_is_scored_with_and_its_lack_is_named() -> None:
    bare = labelled_scene(10.0)
    lane_map = LaneMap(
        (
            LaneArea(1, rectangle(-50, -1.75, 150, 1.75), True),
            LaneArea(2, rectangle(-50, 1.75, 150, 5.25), False),
        ),
        (rectangle(60, -6, 80, 6),),
        np.array([[-20.0, 0.0], [140.0, 0.0]]),
        has_lights=False,
    )
    expert = plans_of(bare.future)
    aside = expert + np.array([0.0, 3.5, 0.0]) * np.clip(expert[:, :1] / 15.0, 0, 1)
    plans, others = np.stack([expert, aside]), Others(reference=expert, against="expert")

    def scored(lane_map: LaneMap | None) -> Scores:
        return score(world_of(replace(bare, lane_map=lane_map)), plans, "v2.2", others, centre=True)

    known = scored(lane_map)
    assert known.missing == (EXTENDED_COMFORT,)
    assert {name: value.tolist() for name, value in known.sub_scores.items() if value is not None} == {
        COLLISIONS: [1, 1],
        DRIVABLE: [1, 1],
        DIRECTION: [1, 0],
        LIGHTS: [1, 1],
        PROGRESS: [1, pytest.approx(1, abs=0.02)],
        TIME_TO_COLLISION: [1, 1],
        LANE_KEEPING: [1, 0],
        COMFORT: [1, 1],
    }
    assert scored(replace(lane_map, has_lights=True)).missing == (LIGHTS, EXTENDED_COMFORT)
    assert scored(replace(lane_map, intersections=())).missing == (EXTENDED_COMFORT,)
    assert scored(None).missing == (DIRECTION, LIGHTS, LANE_KEEPING, EXTENDED_COMFORT)


def test_the_smoothing_is_scipys() -> None:
    signal = pytest.importorskip("scipy.signal")
    dice = np.random.default_rng(0)
    for count, window, order, derivative in ((41, 8, 2, 0), (55, 15, 2, 1), (41, 41, 2, 1), (36, 5, 3, 2)):
        values = dice.normal(size=(3, count))
        expected = signal.savgol_filter(values, window, order, deriv=derivative, delta=0.1)
        assert values @ _filter(count, window, order, derivative).T == pytest.approx(expected, abs=1e-9)
