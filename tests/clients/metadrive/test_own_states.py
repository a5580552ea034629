"""Scenes of a planner's own drives: its past, and the expert's future from there."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from clients.metadrive.drive import TAKE_OVER, DriveConfig
from clients.metadrive.generate import GenerateConfig, GenerationError, generate
from clients.metadrive.own_states import own_states
from clients.metadrive.pilots import ConstantVelocity, Planned
from clients.metadrive.replay import ReplayError, setting_of
from model.driving.metrics import collides, leaves_road
from model.driving.scene import Scene
from model.driving.scene_store import read_scenes
from model.driving.tracks import Track
from service.cli.scenes import served_pilot
from service.settings import Settings
from tests.clients.metadrive.conftest import SEED
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve

CONFIG = DriveConfig(duration_s=12.0)


class Remembering(ConstantVelocity):
    """Knows what it was shown."""

    def __init__(self) -> None:
        self.shown: dict[str, Scene] = {}

    def plan(self, scene: Scene) -> Planned:
        self.shown[scene.scene_id] = scene
        return super().plan(scene)


def _place(track: Track) -> tuple[float, float, float]:
    return track.x_m, track.y_m, track.speed_ms


def test_own_states_are_what_the_pilot_met_and_what_the_expert_would_do() -> None:
    pilot = Remembering()
    states, drove = own_states(SEED, pilot, config=CONFIG, every=2)
    assert drove.plans == len(pilot.shown)
    assert 3 < len(states) <= drove.plans // 2
    for labelled in states:
        scene = labelled.scene
        shown = pilot.shown[scene.scene_id]
        np.testing.assert_array_equal(scene.history, shown.history)
        np.testing.assert_array_equal(scene.route, shown.route)
        # A scene keeps who comes near; others are farther off, and so told last.
        kept = [_place(each) for each in labelled.given(route=True, tracks=True).tracks or ()]
        told = [pytest.approx(_place(each), abs=1e-3) for each in shown.tracks or ()]
        assert kept
        assert kept == told[: len(kept)]
        future = labelled.future[None]
        assert not collides(future, labelled.agents, 6.4)[0]
        assert not leaves_road(future, labelled.drivable)[0]
        assert labelled.lane_map is not None
    steps = [int(labelled.scene.scene_id.split("-")[1]) for labelled in states]
    assert all((step - TAKE_OVER) % 10 == 5 for step in steps)


def test_a_served_model_s_own_drives_become_scenes(tmp_path: Path) -> None:
    config = GenerateConfig(
        stride_s=2.0, duration_s=8.0, block=1, dense=False, width_px=112, driver="scripted 1"
    )
    with serve(ScriptedEngine(), Settings()) as served:
        report = generate(
            tmp_path,
            range(4, 5),
            workers=1,
            config=config,
            pilot=partial(served_pilot, served.url, tracks=False),
        )
    scenes = list(read_scenes(tmp_path))
    assert report.scenes == len(scenes) > 0
    for labelled in scenes:
        for clip in labelled.scene.clips:
            assert {Image.open(io.BytesIO(image)).size for image in clip.images} == {(112, 56)}
    with pytest.raises(ReplayError, match="what scripted 1 met"):
        setting_of(tmp_path)


def test_a_pilot_without_eyes_has_pictures_where_they_are_wanted(tmp_path: Path) -> None:
    config = GenerateConfig(
        stride_s=2.0, duration_s=8.0, block=1, dense=False, width_px=112, driver="constant velocity"
    )
    for pictures in (True, False):
        folder = tmp_path / str(pictures)
        asked = replace(config, pictures=pictures)
        assert generate(folder, range(4, 5), workers=1, config=asked, pilot=ConstantVelocity).scenes > 0
        assert {labelled.scene.has_pictures for labelled in read_scenes(folder)} == {pictures}
    with pytest.raises(GenerationError, match="can do without pictures"):
        GenerateConfig(pictures=False)


def test_what_only_the_expert_s_drives_have_is_refused() -> None:
    with pytest.raises(GenerationError, match="no dense targets"):
        GenerateConfig(driver="scripted 1")
