from __future__ import annotations

from dataclasses import replace

import numpy as np

from looktwice.model.driving.images import decode_image
from looktwice.model.driving.variations import fresh, moved
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
