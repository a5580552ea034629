from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.images import encode_png
from looktwice.model.driving.scene import Clip, LabelledScene, NextFrame
from looktwice.model.evaluation.next_frames import (
    copied,
    frechet_distance,
    frechet_interval,
    measure_pictures,
    warped,
    what_came,
)
from looktwice.model.network.visual_codes import Frame
from tests.model.driving.drives import labelled_scene

RANDOM = np.random.default_rng(0)


def stripes(nearest_m: float) -> Frame:
    """A road with stripes across, seen by the front camera from where the next one is so far away."""
    camera = CAMERA_SPECS["front"]
    frame = np.zeros((112, 224, 3), np.uint8)
    for row in range(int(camera.horizon * 112) + 8, 112):
        below = row + 0.5 - camera.horizon * 112
        ahead_m = camera.focal_px * camera.up_m / below + camera.forward_m
        frame[row] = 255 if (ahead_m - nearest_m) % 8.0 < 4.0 else 0
    return frame


def filmed(number: int, now: Frame, then: Frame) -> LabelledScene:
    labelled = labelled_scene(6.0, scene_id=str(number), episode_id=f"episode-{number // 2}")
    clip = Clip("front", (encode_png(now),) * 4)
    scene = replace(labelled.scene, clips=(*labelled.scene.clips, clip))
    return replace(labelled, scene=scene, next_frames=(NextFrame("front", encode_png(then)),))


def pixels(frame: Frame) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return frame[60:70:5, ::40].reshape(-1, 3) / 255


def test_a_picture_moved_as_the_ego_is_nearer_than_the_last_one() -> None:
    # At 6 m/s stripes are 3 m nearer in half a second.
    scenes = [filmed(number, stripes(number), stripes(number - 3.0)) for number in range(4)]
    cameras = dict.fromkeys(("0", "1", "2", "3"), "front")
    found = measure_pictures(scenes, cameras, {"copied": copied, "warped": warped, "came": what_came}, pixels)
    for copy, moved, came in zip(
        *(found[name].results for name in ("copied", "warped", "came")), strict=True
    ):
        assert copy.psnr_db + 5 < moved.psnr_db < came.psnr_db
        assert came.feature_distance == 0 <= moved.feature_distance < copy.feature_distance
    assert found["came"].frechet == pytest.approx(0, abs=1e-9)


def test_what_did_not_come_is_asked_for_in_vain() -> None:
    with pytest.raises(ValueError, match="does not bring what back saw"):
        what_came(filmed(0, stripes(0), stripes(0)), "back")


def test_frechet_distances_by_hand() -> None:
    some = RANDOM.normal(size=(400, 3))
    assert frechet_distance(some, some) == pytest.approx(0, abs=1e-9)
    assert frechet_distance(some, some + np.array([3.0, 4.0, 0.0])) == pytest.approx(25)
    # One dimension: (difference of means)^2 + (difference of deviations)^2.
    one = RANDOM.normal(2.0, 1.0, (50, 1))
    other = 3 * one - 1
    apart = float(one.mean() - other.mean()) ** 2 + (2 * float(one.std(ddof=1))) ** 2
    assert frechet_distance(one, other) == pytest.approx(apart)


def test_frechet_intervals_hold_the_figure_and_narrow_with_episodes() -> None:
    widths = []
    for count in (40, 640):
        one, other = RANDOM.normal(size=(count, 2)), RANDOM.normal(1.0, 1.0, (count, 2))
        value, interval = frechet_interval(one, other, [str(place // 4) for place in range(count)])
        assert value is not None
        assert interval is not None
        assert interval[0] < value < interval[1]
        widths.append(interval[1] - interval[0])
    assert widths[1] < widths[0] / 2


def test_a_single_episode_has_no_interval_and_a_single_picture_no_distance() -> None:
    rows = RANDOM.normal(size=(4, 2))
    assert frechet_interval(rows, rows, ["a"] * 4)[1] is None
    assert frechet_interval(rows[:1], rows[:1], ["a"]) == (None, None)
