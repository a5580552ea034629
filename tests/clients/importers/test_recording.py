"""Scenes of a recording in which poses are missing for a while."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from looktwice.clients.importers.recording import Recording
from looktwice.clients.summaries.stats import scene_stats
from looktwice.model.driving.cameras import FRONT_CAMERAS, CameraSpec
from looktwice.model.driving.scene import NO_PICTURE
from looktwice.model.driving.scene_store import write_scenes

SPEED_MS = 10.0


class Shut:
    """A camera that is there and shows nothing."""

    @property
    def spec(self) -> CameraSpec:
        return FRONT_CAMERAS[0]

    def at(self, moment_s: float) -> bytes | None:
        return NO_PICTURE

    def doubts(self) -> list[str]:
        return []


def straight(times_s: np.ndarray, x_m: float, y_m: float, heading_rad: float) -> np.ndarray:
    along_m = SPEED_MS * (times_s - times_s[0])
    x, y = x_m + np.cos(heading_rad) * along_m, y_m + np.sin(heading_rad) * along_m
    return np.stack([x, y, 0 * x, np.full(len(x), heading_rad)], axis=1)


def interrupted() -> Recording:
    """Twenty seconds straight on, a minute of which nothing is known, twenty seconds somewhere else."""
    first_s, second_s = np.arange(0, 20.01, 0.1), np.arange(80.0, 100.01, 0.1)
    poses = np.concatenate([straight(first_s, 0, 0, 0), straight(second_s, 1000, 500, np.pi / 2)])
    return Recording("drive", np.concatenate([first_s, second_s]), poses, (Shut(),))


def test_nothing_is_made_up_where_poses_are_missing() -> None:
    found = list(interrupted().scenes(stride_s=0.1, route=True))
    assert len(found) > 200
    for labelled in found:
        driven = np.concatenate([labelled.scene.history, labelled.future])[:, :2]
        speeds_ms = np.hypot(*np.diff(driven, axis=0).T) / 0.1
        np.testing.assert_allclose(speeds_ms, SPEED_MS, atol=0.01)
        if labelled.scene.route is not None:
            np.testing.assert_allclose(labelled.scene.route[:, 1], 0, atol=1e-3)
    routes = sum(labelled.scene.route is not None for labelled in found)
    assert 0 < routes < len(found), "80 m before the hole, and before the end, there is none"


def test_nobody_is_off_a_road_that_is_not_known(tmp_path: Path) -> None:
    write_scenes(tmp_path / "a.parquet", list(interrupted().scenes(stride_s=5.0)))
    assert scene_stats(tmp_path / "a.parquet")["expert_off_road"] is None
