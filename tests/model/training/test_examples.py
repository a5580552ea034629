from __future__ import annotations

import os
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from looktwice.model.driving.images import decode_image
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.perceived import perceived_of
from looktwice.model.driving.reasoning import thoughts_of
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, NO_PICTURE, NextFrame
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.training.dense import UNLABELLED, coarse
from looktwice.model.training.examples import Examples, load_examples
from tests.model.training.scenes import training_scene

CAMERAS = (FRONT_WIDE, FRONT_TELE)
SCENES = [training_scene(index) for index in range(6)]


def test_examples_hold_what_the_scenes_hold() -> None:
    examples = Examples.from_scenes(SCENES, CAMERAS)
    assert len(examples) == 6
    for index, labelled in enumerate(SCENES):
        assert examples.picture(index, 1, 3) == labelled.scene.clip(FRONT_TELE).images[3]
        assert decode_image(examples.picture(index, 0, 0)).ndim == 3
        assert examples.plan(index) == expert_plan(labelled)
        assert examples.thought(index) == thoughts_of(labelled) is not None
        told, perceived = examples.perception(index), perceived_of(labelled)
        assert told is not None
        assert perceived is not None
        np.testing.assert_array_equal(told.row(), perceived.row())
        assert np.array_equal(examples.future[index], labelled.future)
        assert np.isnan(examples.route[index]).all() == (labelled.scene.route is None)
        assert np.array_equal(examples.dense_classes[index, 0], coarse(labelled.dense[0]).classes)
        metres = np.expm1(examples.dense_range_log[index, 1].astype(np.float32))
        assert np.allclose(metres, coarse(labelled.dense[1]).range_m, atol=0.2)


def test_examples_know_which_have_pictures() -> None:
    scene = SCENES[1].scene
    clips = tuple(replace(clip, images=(NO_PICTURE,) * 4) for clip in scene.clips)
    blind = replace(SCENES[1], scene=replace(scene, clips=clips))
    assert not blind.scene.has_pictures
    assert Examples.from_scenes([SCENES[0], blind, SCENES[2]], CAMERAS).pictured.tolist() == [
        True,
        False,
        True,
    ]


def test_thoughts_are_known_where_annotations_tell_them() -> None:
    examples = Examples.from_scenes([replace(SCENES[0], lane_lines=()), SCENES[1]], CAMERAS)
    assert examples.thought(0) is None
    assert examples.thought(1) == thoughts_of(SCENES[1])


def test_what_is_perceived_is_known_where_the_road_is() -> None:
    examples = Examples.from_scenes([replace(SCENES[1], drivable=()), SCENES[1]], CAMERAS)
    assert examples.perception(0) is None
    known = examples.perception(1)
    assert known is not None
    [vehicle] = known.agents
    assert (vehicle.kind, vehicle.x_m) == ("vehicle", 11.0)


def test_scenes_without_dense_targets_are_examples_too() -> None:
    examples = Examples.from_scenes([replace(SCENES[0], dense=()), SCENES[1]], CAMERAS)
    assert (examples.dense_classes[0] == UNLABELLED).all()
    assert not (examples.dense_classes[1] == UNLABELLED).any()
    assert not examples.dense_range_log[0].any()


def test_each_folder_and_each_choice_of_cameras_has_a_cache_of_its_own(tmp_path: Path) -> None:
    for name, scenes in (("one", SCENES[:2]), ("two", SCENES[2:5])):
        write_scenes(tmp_path / name / "scenes" / "a.parquet", scenes)
    cache = tmp_path / "cache"
    assert len(load_examples(tmp_path / "one" / "scenes", cache, CAMERAS)) == 2
    assert len(load_examples(tmp_path / "two" / "scenes", cache, CAMERAS)) == 3
    assert load_examples(tmp_path / "one" / "scenes", cache, CAMERAS[:1]).picture_spans.shape[1] == 1


def test_pictures_are_kept_once() -> None:
    once = Examples.from_scenes(SCENES[:1], CAMERAS)
    twice = Examples.from_scenes([SCENES[0], SCENES[0]], CAMERAS)
    assert len(twice.pictures) == len(once.pictures)


def test_joining_keeps_every_picture_in_its_place() -> None:
    joined = Examples.concatenate(
        [Examples.from_scenes(SCENES[:2], CAMERAS), Examples.from_scenes(SCENES[2:], CAMERAS)]
    )
    whole = Examples.from_scenes(SCENES, CAMERAS)
    for index in range(6):
        assert joined.picture(index, 0, 1) == whole.picture(index, 0, 1)


def test_next_frames_are_kept_camera_by_camera() -> None:
    wide = SCENES[1].scene.clip(FRONT_WIDE).images[0]
    frames = (NextFrame("back_right", b"behind"), NextFrame(FRONT_WIDE, wide))
    later = replace(SCENES[1], next_frames=frames)
    examples = Examples.concatenate(
        [Examples.from_scenes(SCENES[:1], CAMERAS), Examples.from_scenes([SCENES[0], later], CAMERAS)]
    )
    assert [examples.next_cameras(index) for index in range(3)] == [(), (), (FRONT_WIDE, "back_right")]
    assert examples.next_picture(2, "back_right") == b"behind"
    assert examples.next_picture(2, FRONT_WIDE) == wide
    for camera in CAMERAS:
        assert examples.now_picture(2, camera) == SCENES[1].scene.clip(camera).images[-1]
    assert examples.now_picture(2, "back_right") is None


def test_the_cache_gives_the_same_and_follows_its_file(tmp_path: Path) -> None:
    write_scenes(tmp_path / "scenes" / "a.parquet", SCENES[:4])
    write_scenes(tmp_path / "scenes" / "b.parquet", SCENES[4:])
    first = load_examples(tmp_path / "scenes", tmp_path / "cache", CAMERAS)
    again = load_examples(tmp_path / "scenes", tmp_path / "cache", CAMERAS)
    for field in fields(Examples):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(again, field.name))
    assert len(first) == 6
    write_scenes(tmp_path / "scenes" / "b.parquet", SCENES[4:5])
    newer = os.stat(tmp_path / "cache").st_mtime + 10
    os.utime(tmp_path / "scenes" / "b.parquet", (newer, newer))
    assert len(load_examples(tmp_path / "scenes", tmp_path / "cache", CAMERAS)) == 5
