"""The small planner of pictures, driving by itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.scene import SceneError
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import constant_velocity
from looktwice.model.network.reading_planner import ReadingPlanner
from looktwice.model.network.small_planner import SmallPlannerError

LABELLED = list(read_scenes(SCENES))


@pytest.fixture(scope="module")
def planner() -> ReadingPlanner:
    return ReadingPlanner(CHECKPOINT)


def test_it_plans_by_what_is_in_the_pictures(planner: ReadingPlanner) -> None:
    scenes = [labelled.scene for labelled in LABELLED]
    others = scenes[6:] + scenes[:6]
    swapped = [replace(scene, clips=other.clips) for scene, other in zip(scenes, others, strict=True)]
    futures = np.stack([labelled.future for labelled in LABELLED])
    own_m, other_m = (
        np.linalg.norm((planner.plan(seen) - futures)[..., :2], axis=-1).mean() for seen in (scenes, swapped)
    )
    kept_on = np.stack([constant_velocity(scene.history) for scene in scenes])
    kept_on_m = np.linalg.norm((kept_on - futures)[..., :2], axis=-1).mean()
    assert own_m < 0.4 * kept_on_m
    assert other_m > 1.2 * own_m


def test_a_scene_is_planned_alike_alone_and_among_others(planner: ReadingPlanner) -> None:
    scenes = [labelled.scene for labelled in LABELLED[:3]]
    np.testing.assert_allclose(planner.plan(scenes)[1], planner.plan(scenes[1:2])[0], atol=0.1)
    assert planner.width_px == 336


def test_without_a_route_or_a_reader_it_says_so(planner: ReadingPlanner, untrained_checkpoint: Path) -> None:
    with pytest.raises(SceneError, match="has no route"):
        planner.plan([replace(LABELLED[0].scene, route=None)])
    with pytest.raises(SmallPlannerError, match="reads no facts in pictures"):
        ReadingPlanner(untrained_checkpoint)
