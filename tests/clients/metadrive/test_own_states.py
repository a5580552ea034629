"""Scenes of a planner's own drives: its past, and the expert's future from there."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from looktwice.clients.metadrive.closed_loop.drives import TAKE_OVER, DriveConfig
from looktwice.clients.metadrive.closed_loop.pilots import Careless, ConstantVelocity, Planned
from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.generation.blocks import (
    GenerateConfig,
    GenerationError,
    generate,
    run_seed,
    write_manifest,
)
from looktwice.clients.metadrive.generation.own_states import own_states
from looktwice.clients.metadrive.outcomes.replayed_worlds import (
    FollowTask,
    Moment,
    ReplayError,
    outcomes_of_episode,
    redriver,
    setting_of,
)
from looktwice.model.bundled import CHECKPOINT
from looktwice.model.driving.facts import hazard_ahead
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.metrics import collides, leaves_road
from looktwice.model.driving.scene import Scene, SceneError
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.tracks import Track
from looktwice.model.driving.trajectory import path_length, present_speed, speeds
from looktwice.model.network.checkpoint import load
from looktwice.model.network.small_planner import SmallPlanner
from looktwice.service.cli.commands import app
from looktwice.service.cli.scenes import _driver, served_pilot
from looktwice.service.cli.small_pilot import SmallPilot
from looktwice.service.operations.settings import Settings
from tests.clients.metadrive.conftest import SEED
from tests.service.scripted_engine import CARD, ScriptedEngine
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


class Halting(Remembering):
    """Would stop at once, wherever it is."""

    def plan(self, scene: Scene) -> Planned:
        super().plan(scene)
        return Planned(np.zeros((64, 4), np.float32), np.zeros((0, 64, 4), np.float32))


def test_a_teacher_says_in_every_state_what_it_would_do() -> None:
    pilot, teacher = Remembering(), Halting()
    states, drove = own_states(SEED, pilot, config=CONFIG, every=2, teacher=teacher)
    assert len(states) == drove.plans // 2 == len(teacher.shown)
    for labelled in states:
        shown = pilot.shown[labelled.scene.scene_id]
        np.testing.assert_array_equal(labelled.scene.history, shown.history)
        np.testing.assert_array_equal(labelled.scene.route, shown.route)
        assert not labelled.future.any()
        kept = [_place(each) for each in labelled.given(route=True, tracks=True).tracks or ()]
        told = [pytest.approx(_place(each), abs=1e-3) for each in shown.tracks or ()]
        assert kept
        assert kept == told[: len(kept)]
        # Nobody knows yet what the others will do.
        assert all(np.isnan(agent.future).all() for agent in labelled.agents)
        assert not expert_plan(labelled).lane


def test_among_hazards_only_their_moments_become_scenes() -> None:
    seed, config = 6, DriveConfig(duration_s=20.0)
    usual, pilot = Remembering(), Remembering()
    own_states(seed, usual, config=config, every=1, teacher=Halting())
    states, drove = own_states(seed, pilot, config=config, every=1, teacher=Halting(), hazards=True)
    assert 0 < len(states) < drove.plans
    ahead = {name for name, scene in pilot.shown.items() if hazard_ahead(scene)}
    assert {labelled.scene.scene_id for labelled in states} == ahead
    assert len(ahead) > sum(map(hazard_ahead, usual.shown.values()))
    with pytest.raises(GenerationError, match="a model has to drive"):
        GenerateConfig(dense=False, hazards=True)


def test_where_even_the_expert_collides_it_brakes() -> None:
    config = DriveConfig(duration_s=20.0)
    states, drove = own_states(6, ConstantVelocity(), config=config, every=1, hazards=True)
    assert drove.ended == "collision"
    lost = [each for each in states if all(np.isnan(agent.future).all() for agent in each.agents)]
    assert lost
    for labelled in lost:
        speeds_ms = speeds(labelled.future)
        assert labelled.future.shape == (64, 4)
        assert np.diff(speeds_ms).max() < 0.1, "it never picks up speed"
        assert present_speed(labelled.scene.history) > 5
        assert speeds_ms[-1] == 0
    assert len(states) > len(lost), "others can be saved"


def test_the_expert_may_take_over_at_another_speed() -> None:
    usual, others = (
        own_states(SEED, ConstantVelocity(), config=CONFIG, every=2, speeds=other)[0]
        for other in (False, True)
    )
    was = {each.scene.scene_id: present_speed(each.scene.history) for each in usual}
    times = []
    for labelled in others:
        speed_ms = present_speed(labelled.scene.history)
        assert abs(float(speeds(labelled.future)[0]) - speed_ms) < 1.0, "it goes on from that speed"
        if (before_ms := was.get(labelled.scene.scene_id)) is not None:
            times.append(speed_ms / before_ms)
    assert len(times) > 2
    assert 0.39 <= min(times) < max(times) <= 1.61


def test_a_planner_that_is_not_told_the_tracks_is_no_teacher(
    untrained_checkpoint: Path, tmp_path: Path
) -> None:
    planner = SmallPlanner("blind", load(untrained_checkpoint).codec)
    planner.save(tmp_path / "blind", {})
    command = ["scenes", "generate", str(tmp_path / "new"), "--first-seed", "4", "--episodes", "1"]
    blind = str(tmp_path / "blind")
    told = CliRunner().invoke(app, [*command, "--no-dense", "--small", blind, "--teacher", blind])
    assert told.exit_code != 0
    assert "--teacher has to plan from tracks" in told.output
    assert not (tmp_path / "new").exists()


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
    with pytest.raises(ReplayError, match="scripted 1 drove these episodes, not the expert"):
        redriver(setting_of(tmp_path), None)


def test_a_served_model_drives_as_its_format_can_be_asked_for() -> None:
    engine = ScriptedEngine()
    with serve(engine, Settings()) as served:
        for formats, name in ((("cf_vla", "elf_vla"), "never"), (("elf_vla", "cf_vla"), "adaptive")):
            engine.card_shown = replace(CARD, formats=formats)
            _, makes = _driver(served.url, None, by="tracks", tracks=False, pictures=True)
            assert makes is not None
            assert makes().name == name


class Steady(ConstantVelocity):
    """Says what manifests call it."""

    described = "constant velocity 1"


def test_plans_are_followed_in_the_worlds_that_a_pilot_met(tmp_path: Path) -> None:
    config = GenerateConfig(
        stride_s=2.0, duration_s=9.0, dense=False, pictures=False, driver=Steady.described
    )
    write_manifest(tmp_path, config)
    states, _ = own_states(SEED, Steady(), config=DriveConfig(config.duration_s), every=4)
    moments = [Moment.of(labelled) for labelled in states]
    assert len(moments) >= 2
    last = moments[-1]
    elsewhere = replace(last, history=last.history + np.float32(0.1))
    late = replace(last, scene_id="late", step=5000)
    asked = [FollowTask(moment, [moment.future]) for moment in (*moments[:-1], elsewhere, late)]
    setting = setting_of(tmp_path)
    *found, moved, missed = outcomes_of_episode(SEED, setting, asked, redriver(setting, Steady))
    assert [scene_id for scene_id, _ in found] == [moment.scene_id for moment in moments[:-1]]
    for _, outcomes in found:
        assert not isinstance(outcomes, ReplayError)
        assert outcomes.plans == (outcomes.expert,)
    assert moved[0] == last.scene_id
    assert "otherwise" in str(moved[1])
    assert missed[0] == late.scene_id
    assert "ended before" in str(missed[1])


def test_a_teacher_s_scenes_have_no_outcomes(tmp_path: Path) -> None:
    config = GenerateConfig(
        stride_s=2.0, duration_s=8.0, dense=False, pictures=False, driver="me 1", teacher="teacher 2"
    )
    write_manifest(tmp_path, config)
    with pytest.raises(ReplayError, match="what teacher 2 says in the expert's place"):
        setting_of(tmp_path)


def test_a_pilot_without_eyes_has_pictures_where_they_are_wanted(rig: Rig) -> None:
    config = GenerateConfig(stride_s=2.0, duration_s=8.0, dense=False, driver="constant velocity")
    for pictures in (True, False):
        asked = replace(config, pictures=pictures)
        scenes, outcome = run_seed(4, rig if pictures else None, asked, ConstantVelocity())
        assert outcome.scenes == len(scenes) > 0
        assert {labelled.scene.has_pictures for labelled in scenes} == {pictures}


def test_the_expert_s_scenes_are_the_same_without_pictures(rig: Rig) -> None:
    config = GenerateConfig(stride_s=1.0, duration_s=16.0, dense=False, drifts=True, lapses=True)
    seen, _ = run_seed(7, rig, config)
    blind, _ = run_seed(7, None, replace(config, pictures=False))
    assert len(seen) == len(blind) > 0
    for one, other in zip(seen, blind, strict=True):
        assert one.scene.has_pictures
        assert not other.scene.has_pictures
        assert one.scene.scene_id == other.scene.scene_id
        np.testing.assert_array_equal(one.scene.history, other.scene.history)
        np.testing.assert_array_equal(one.future, other.future)
        assert len(one.agents) == len(other.agents)


def test_a_careless_pilot_overlooks_everybody_for_a_while(tmp_path: Path) -> None:
    scene = own_states(SEED, ConstantVelocity(), config=CONFIG)[0][0].given(route=True, tracks=True)
    assert scene.tracks
    runs: list[list[bool]] = []
    for seed in range(40):
        pilot = Remembering()
        careless, overlooked = Careless(pilot, seed), list[bool]()
        for _ in range(80):
            careless.plan(scene)
            overlooked.append(not pilot.shown[scene.scene_id].tracks)
        runs.append(overlooked)
    assert 10 < sum(not any(run) for run in runs) < 30
    lengths = [len(each) for run in runs for each in "".join("x" if one else " " for one in run).split()]
    assert min(lengths) == 1
    again = Careless(pilot := Remembering(), 3)
    for told in runs[3]:
        again.plan(scene)
        assert told == (not pilot.shown[scene.scene_id].tracks)
    with pytest.raises(GenerationError, match="the expert has lapses"):
        GenerateConfig(dense=False, careless=True)


def test_a_careless_pilot_sees_late_who_stands_and_who_walks() -> None:
    scene = own_states(SEED, ConstantVelocity(), config=CONFIG)[0][0].scene
    standing = [Track(5.0 * n, 0.0, 0.0, 0.0, 4.0, 1.8, "vehicle") for n in range(1, 13)]
    walking = Track(70.0, 3.0, 1.5, 1.4, 0.6, 0.6, "pedestrian")
    moving = Track(70.0, 0.0, 0.0, 9.0, 4.0, 1.8, "vehicle")
    seen_m: list[float] = []
    for seed in range(40):
        pilot = Remembering()
        Careless(pilot, seed).plan(replace(scene, tracks=(*standing, walking, moving)))
        shown = pilot.shown[scene.scene_id].tracks
        if not shown:
            continue  # it overlooks everybody just now
        assert moving in shown
        seen_m.append(max(track.x_m for track in shown if track is not moving))
    assert 5 < sum(each == 70.0 for each in seen_m) < 20, "a quarter of the episodes see everybody"
    assert {each for each in seen_m if each != 70.0} == {15.0, 20.0, 30.0}


def test_carelessness_is_refused_where_nobody_plans_from_tracks(tmp_path: Path) -> None:
    command = ["scenes", "generate", str(tmp_path / "new"), "--first-seed", "4", "--episodes", "1"]
    told = CliRunner().invoke(app, [*command, "--no-dense", "--service", "http://127.0.0.1:9", "--careless"])
    assert told.exit_code != 0
    assert "--careless is for --small" in told.output
    assert not (tmp_path / "new").exists()


def test_a_small_planner_of_pictures_meets_states_of_its_own(tmp_path: Path) -> None:
    pilot = SmallPilot(CHECKPOINT, "pictures")
    assert pilot.described.startswith("pictures ")
    config = GenerateConfig(stride_s=2.0, duration_s=8.0, dense=False, driver=pilot.described)
    scenes, outcome = run_seed(4, Rig.of_width(pilot.width_px), config, pilot, SmallPilot(CHECKPOINT))
    assert outcome.scenes == len(scenes) > 0
    assert all(labelled.scene.has_pictures for labelled in scenes)
    command = ["scenes", "generate", str(tmp_path / "new"), "--first-seed", "4", "--episodes", "1"]
    drives = ["--small", str(CHECKPOINT), "--by", "pictures"]
    for refused, message in (
        (["--by", "pictures"], "--by is for --small"),
        (["--by", "facts"], "--by is for --small"),
        ([*drives, "--no-pictures"], "--by pictures needs pictures"),
        ([*drives, "--careless"], "--careless is for --small, where it plans from tracks or facts"),
    ):
        told = CliRunner().invoke(app, [*command, "--no-dense", *refused])
        assert told.exit_code != 0
        assert message in told.output
        assert not (tmp_path / "new").exists()


def test_the_planner_of_pictures_drives_by_true_facts_too() -> None:
    pilot = SmallPilot(CHECKPOINT, "facts")
    assert pilot.described.startswith("facts ")
    assert not pilot.needs_pictures
    states, drove = own_states(SEED, pilot, config=CONFIG, every=4)
    assert drove.plans > 4
    assert drove.driven_m > 30.0
    scene = replace(states[0].scene, tracks=states[0].given(route=True, tracks=True).tracks)
    alone = replace(scene, tracks=())
    lead = Track(9.0, 0.0, 0.0, 0.0, 4.5, 1.9, "vehicle")
    blocked = replace(scene, tracks=(lead,))
    free_m, stopped_m = (path_length(pilot.plan(each).trajectory) for each in (alone, blocked))
    assert stopped_m < 0.7 * free_m, "it heeds what it is told"
    for lacking in (replace(scene, tracks=None), replace(scene, route=None)):
        with pytest.raises(SceneError, match="lacks its route or its tracks"):
            pilot.plan(lacking)


def test_what_only_the_expert_s_drives_have_is_refused() -> None:
    with pytest.raises(GenerationError, match="no dense targets"):
        GenerateConfig(driver="scripted 1")
    with pytest.raises(GenerationError, match="without pictures there are no dense targets"):
        GenerateConfig(pictures=False)
