from __future__ import annotations

from dataclasses import replace

import numpy as np

from model.bench.scenes import fresh, moved
from model.bench.workload import Workload
from model.driving.images import decode_image
from tests.checkpoints import noisy_scene


def test_fresh_scenes_are_new_to_caches_and_hardly_changed() -> None:
    scene = noisy_scene()
    one, other = fresh(scene, 1), fresh(scene, 2)
    images = {image for each in (scene, one, other) for clip in each.clips for image in clip.images}
    assert len(images) == 3 * 8
    before, after = (decode_image(each.clips[0].images[0]) for each in (scene, one))
    difference = np.abs(before.astype(int) - after.astype(int))[16:, 16:]
    assert difference.mean() < 20, "noise coded twice, and nothing else"
    np.testing.assert_array_equal(one.history, scene.history)


def test_all_contenders_are_asked_the_same() -> None:
    load = Workload(3, 2, "always", temperature=0.5)
    scenes = [noisy_scene(0), noisy_scene(1)]
    first, again, next_round = (load.requests(scenes, number) for number in (4, 4, 5))
    assert [each.request_id for each in first] == [each.request_id for each in again]
    assert [each.scene.clips for each in first] == [each.scene.clips for each in again]
    assert not {each.controls.seed for each in first} & {each.controls.seed for each in next_round}
    assert {(each.controls.n, each.controls.thinking, each.controls.temperature) for each in first} == {
        (2, "always", 0.5)
    }


def test_a_moved_ego_stays_on_its_way() -> None:
    scene = noisy_scene()
    radius_m, turn = 20.0, 0.05
    angle = turn * np.arange(-15, 1)
    history = np.stack(
        [radius_m * np.sin(angle), radius_m * (1 - np.cos(angle)), 0 * angle, angle], axis=1
    ).astype(np.float32)
    later = moved(replace(scene, history=history), 3)
    # On a circle every instant looks like every other.
    np.testing.assert_allclose(later.history, history, atol=1e-4)
    assert later.clips == scene.clips
