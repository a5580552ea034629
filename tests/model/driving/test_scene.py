from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.scene import (
    FRONT_TELE,
    FRONT_WIDE,
    Agent,
    Clip,
    LabelledScene,
    LaneTrace,
    Scene,
    SceneError,
    split_of_seed,
)
from looktwice.model.driving.trajectory import GeometryError
from tests.model.driving.drives import agent, clips, drive, labelled_scene


def test_a_scene_checks_its_arrays_and_keeps_them_read_only() -> None:
    scene = labelled_scene().scene
    assert not scene.history.flags.writeable
    assert scene.route is not None
    assert not scene.route.flags.writeable
    with pytest.raises(GeometryError, match="history"):
        replace(scene, history=np.zeros((15, 4), np.float32))
    with pytest.raises(GeometryError, match="route"):
        replace(scene, route=np.full((20, 2), np.nan, np.float32))


@pytest.mark.parametrize("count", [0, 3, 100])
def test_a_clip_has_four_frames(count: int) -> None:
    with pytest.raises(SceneError, match=f"must have 4 frames, got {count}"):
        Clip(FRONT_WIDE, (b"x",) * count)


def test_cameras_are_known_and_different() -> None:
    _, history = drive(5.0)
    with pytest.raises(SceneError, match="unknown camera 'dashcam'"):
        Clip("dashcam", (b"x",) * 4)
    with pytest.raises(SceneError, match="occurs twice"):
        Scene("s", (clips()[0], clips()[0]), history)
    with pytest.raises(SceneError, match="at least one"):
        Scene("s", (), history)


def test_a_clip_is_found_by_its_camera() -> None:
    scene = labelled_scene().scene
    assert scene.clip(FRONT_TELE).camera == FRONT_TELE
    with pytest.raises(SceneError, match="no clip of camera back"):
        scene.clip("back")


def test_an_agents_rows_are_history_then_future() -> None:
    moving = agent(x=10.0, y=2.0, speed=5.0)
    np.testing.assert_allclose(moving.present, [10, 2, 0])
    np.testing.assert_allclose(moving.future[0], [10.5, 2, 0])
    np.testing.assert_allclose(moving.future[-1], [42, 2, 0], rtol=1e-6)
    with pytest.raises(SceneError, match=r"\[80, 3\]"):
        Agent(1, "vehicle", 4, 2, 1.5, moving.poses[1:])


def test_a_lane_trace_covers_past_and_future() -> None:
    with pytest.raises(SceneError, match="lane must have shape"):
        LaneTrace(np.zeros(80, np.int32), np.zeros(64, np.int16), np.zeros(80, np.float32))


def test_a_labelled_scene_checks_future_and_tags() -> None:
    good = labelled_scene()
    with pytest.raises(GeometryError, match="trajectory"):
        replace(good, future=good.future[:-1])
    with pytest.raises(SceneError, match="unknown tags: fog"):
        LabelledScene(good.scene, "e", 1, good.future, tags=frozenset({"fog"}))  # type: ignore[arg-type]


def test_the_seed_decides_the_split() -> None:
    edges = {0: "train", 499_999: "train", 500_000: "validation", 599_999: "validation", 600_000: "test"}
    assert {seed: split_of_seed(seed) for seed in edges} == edges
    assert labelled_scene().split == "validation"
    for held_back in (-1, 700_000):
        with pytest.raises(SceneError, match="not in use"):
            split_of_seed(held_back)
