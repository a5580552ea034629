"""The closed loop, with real pictures and a real socket; the oracle knows what the expert did."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from looktwice.clients import wire
from looktwice.clients.metadrive.closed_loop.driver_table import (
    driver_comparisons,
    driver_rows,
    drives_to_json,
    format_driver_rows,
)
from looktwice.clients.metadrive.closed_loop.drives import (
    EXPERT,
    TAKE_OVER,
    Drive,
    DriveConfig,
    Shot,
    drive,
    drive_store,
)
from looktwice.clients.metadrive.closed_loop.film import IMAGINED, Film
from looktwice.clients.metadrive.closed_loop.pilots import ConstantVelocity, Planned, ServicePilot
from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.world.episode import make_world, run_episode
from looktwice.clients.metadrive.world.episode_log import EpisodeLog
from looktwice.clients.metadrive.world.tracking import FreeVehicle, world_trajectory
from looktwice.clients.planner import PlannerClient
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.trajectory import to_ego_frame
from looktwice.service.operations.settings import Settings
from tests.clients.metadrive.conftest import SEED
from tests.service.scripted_engine import CARD, ScriptedEngine
from tests.service.serving import serve

CONFIG = DriveConfig(duration_s=12.0)
NOBODY = np.zeros((0, 64, 4), np.float32)


class Oracle:
    """Plans what the expert did in the same episode, from wherever the car is."""

    name = "oracle"
    needs_pictures = True

    def __init__(self, log: EpisodeLog) -> None:
        self._log, self.scenes = log, list[Scene]()
        self._cars: list[FreeVehicle] = []

    def plan(self, scene: Scene) -> Planned:
        self.scenes.append(scene)
        step = int(scene.scene_id.split("-")[1])
        ego = self._log.ego
        rows = [min(step + k, len(ego) - 1) for k in range(65)]
        poses = np.zeros((65, 4))
        poses[:, :2], poses[:, 3] = ego[rows, :2], ego[rows, 2]
        seen = to_ego_frame(poses, poses[0])
        return Planned(seen[1:].astype(np.float32), NOBODY)


@pytest.fixture(scope="module")
def expert(rig: Rig) -> Drive:
    return drive(SEED, None, rig, CONFIG)


def test_the_expert_drives_as_in_its_own_episode(expert: Drive) -> None:
    log = run_episode(SEED, CONFIG.duration_s)
    assert expert.ended == log.outcome
    assert expert.driven_m > 20
    assert not expert.off_road
    assert (expert.plans, expert.thought) == (0, None)
    again = make_world(SEED, CONFIG.duration_s)
    near = again.remember()
    while not again.ended:
        again.move(near, again.drive_as_expert)
        near = again.remember()
    np.testing.assert_array_equal(again.log().ego, log.ego)


@pytest.fixture(scope="module")
def oracle_drive(rig: Rig) -> tuple[Oracle, Drive]:
    oracle = Oracle(run_episode(SEED, CONFIG.duration_s + 7.0))
    return oracle, drive(SEED, oracle, rig, CONFIG)


def test_who_plans_what_the_expert_did_gets_as_far(oracle_drive: tuple[Oracle, Drive], expert: Drive) -> None:
    oracle, drove = oracle_drive
    assert drove.driven_m == pytest.approx(expert.driven_m, rel=0.1)
    assert drove.ended == "time"
    assert not drove.off_road
    assert drove.plans == len(oracle.scenes) == (round(CONFIG.duration_s * 10) - TAKE_OVER + 4) // 5


def test_a_scene_holds_what_the_car_sees_and_nothing_else(oracle_drive: tuple[Oracle, Drive]) -> None:
    oracle, _ = oracle_drive
    first, second = oracle.scenes[:2]
    assert [len(clip.images) for clip in first.clips] == [4, 4]
    assert first.route is not None
    assert first.history[-1].tolist() == [0, 0, 0, 0]
    # Half a second later the clips have moved on by one picture.
    for before, after in zip(first.clips, second.clips, strict=True):
        assert before.images[1:] == after.images[:-1]


def test_constant_velocity_goes_straight_on(rig: Rig) -> None:
    drove = drive(SEED, ConstantVelocity(), rig, CONFIG)
    assert drove.plans > 0
    assert drove.thought is None
    assert drove.lateral_ms2 < 0.1


def test_a_car_follows_a_curve_that_it_is_shown() -> None:
    world = make_world(SEED, 20.0)
    car = FreeVehicle.from_rails(world.ego)
    car.speed = 10.0
    times = 0.1 * np.arange(1, 65)
    angle = 10.0 * times / 40.0  # a circle of 40 m at 10 m/s
    curve = np.stack([40 * np.sin(angle), 40 * (1 - np.cos(angle)), 0 * times, angle], axis=1)
    way = world_trajectory(np.array([car.x, car.y, car.heading, car.speed]), curve.astype(np.float32))
    apart = []
    for step in range(40):
        car.follow(way, 0.1 * step, world.live.road_map)
        apart.append(np.hypot(*(way[step + 1, :2] - [car.x, car.y])))
    assert max(apart) < 0.6
    assert car.speed == pytest.approx(10.0, abs=0.5)


def test_a_car_stops_where_its_trajectory_ends() -> None:
    world = make_world(SEED, 20.0)
    car = FreeVehicle.from_rails(world.ego)
    car.speed = 8.0
    times = np.minimum(0.1 * np.arange(1, 65), 4.0)
    stop = np.zeros((64, 4), np.float32)
    stop[:, 0] = 8.0 * times - times**2
    way = world_trajectory(np.array([car.x, car.y, car.heading, car.speed]), stop)
    for step in range(64):
        car.follow(way, 0.1 * step, world.live.road_map)
    assert abs(car.speed) < 0.3
    assert np.hypot(*(way[-1, :2] - [car.x, car.y])) < 1.0


def test_it_drives_through_the_api(rig: Rig, tmp_path: Path) -> None:
    engine, film, shots = ScriptedEngine(), Film(), list[Shot]()
    engine.card_shown = replace(CARD, formats=("traj_only", "cf_vla"))

    def on_shot(shot: Shot) -> None:
        shots.append(shot)
        film.add(shot)

    with (
        serve(engine, Settings(bundled_scenes=tmp_path / "none")) as served,
        PlannerClient(served.url) as planner,
    ):
        controls = wire.Controls(n=3, thinking="always", deadline_ms=60_000)
        pilot = ServicePilot(planner, "always", controls, route=False, format="cf_vla")
        drove = drive(SEED, pilot, rig, replace(CONFIG, duration_s=4.0), on_shot)
    assert drove.plans == len(engine.submitted) > 3
    assert (drove.thought, drove.late) == (1.0, 0)
    assert {request.controls.seed for request in engine.submitted} == set(range(drove.plans))
    assert all(request.scene.route is None for request in engine.submitted)
    assert {request.format for request in engine.submitted} == {"cf_vla"}
    assert drove.milliseconds is not None
    planned = shots[-1].planned
    assert planned is not None
    assert planned.thinking
    assert "longitudinal" in planned.words
    film.save(tmp_path / "drive.gif")
    with Image.open(tmp_path / "drive.gif") as gif:
        assert gif.n_frames == len(shots)  # type: ignore[attr-defined]  # a GIF has it
        gif.seek(len(shots) - 1)
        frame = np.asarray(gif.convert("RGB")).astype(int)
    # Both cameras and the road from above fill their columns to the bottom; the words have the rest.
    drawn = np.abs(frame - frame[-1, -1]).max(axis=2) > 8
    assert drawn[:, :560].any(axis=1).mean() > 0.98
    assert drawn[:, 560:860].any(axis=1).mean() > 0.98
    words = np.flatnonzero(drawn[:, 860:].any(axis=1))
    assert words[-1] > 0.3 * len(frame)
    with pytest.raises(ValueError, match="frame"):
        Film().save(tmp_path / "none.gif")


@pytest.mark.parametrize("tracks", [False, True])
def test_the_served_model_is_told_the_tracks_where_it_is_to_be(
    rig: Rig, tmp_path: Path, tracks: bool
) -> None:
    engine, seen = ScriptedEngine(), list[Scene]()
    engine.card_shown = replace(CARD, inputs=("route", "tracks"))
    with (
        serve(engine, Settings(bundled_scenes=tmp_path / "none")) as served,
        PlannerClient(served.url) as planner,
    ):
        pilot = ServicePilot(planner, "never", wire.Controls(n=1, thinking="never"), tracks=tracks)
        config = replace(CONFIG, duration_s=3.0)
        drive(SEED, pilot, rig, config, on_plan=lambda _, scene: seen.append(scene))
    assert len(engine.submitted) == len(seen) > 1
    for request, scene in zip(engine.submitted, seen, strict=True):
        assert scene.tracks, "somebody is around"
        assert request.scene.tracks == (scene.tracks if tracks else None)


def test_a_film_shows_what_was_imagined_beside_what_came(rig: Rig, tmp_path: Path) -> None:
    engine, film, shots = ScriptedEngine(), Film(imagines=True), list[Shot]()
    engine.card_shown = replace(CARD, formats=("cf_vla", "vla_world"), paints=True)

    def on_shot(shot: Shot) -> None:
        shots.append(shot)
        film.add(shot)

    with (
        serve(engine, Settings(bundled_scenes=tmp_path / "none")) as served,
        PlannerClient(served.url) as planner,
    ):
        pilot = ServicePilot(planner, "never", wire.Controls(n=1, thinking="never"), imagines=IMAGINED)
        drove = drive(SEED, pilot, rig, replace(CONFIG, duration_s=3.0), on_shot)
    cameras = [request.controls.camera for request in engine.submitted]
    assert cameras == [None, IMAGINED] * drove.plans
    film.save(tmp_path / "drive.gif")
    strips = []
    with Image.open(tmp_path / "drive.gif") as gif:
        for place in range(len(shots)):
            gif.seek(place)
            strips.append(np.asarray(gif.convert("RGB")).astype(int)[-200:])
    middle = strips[0].shape[1] // 2
    paper = strips[0][-1, -1]
    for shot, strip in zip(shots, strips, strict=True):
        drawn = np.abs(strip - paper).max(axis=2) > 8
        came, imagined = drawn[:, :middle], drawn[:, middle:]
        assert came.mean() > 0.9
        # The first picture is of half a second after the first plan.
        assert (imagined.mean() > 0.9) == (shot.step > TAKE_OVER)


def test_drivers_are_compared_over_the_same_episodes() -> None:
    whole = Drive(1, "time", 200.0, False, 3.0, 1.0)
    half = Drive(1, "collision", 100.0, True, 5.0, 2.0, 10, 0.2, 1, 250.0)
    expert, mine = driver_rows({EXPERT: [whole, whole], "adaptive": [half, whole]})
    assert (expert.route_completion, mine.route_completion) == pytest.approx((1.0, 0.75))
    assert (mine.collisions, mine.off_road, mine.deadline_misses, mine.think_rate) == (1, 1, 1, 0.2)
    assert "adaptive" in format_driver_rows([expert, mine])
    longer = Drive(2, "time", 200.0, False, 3.0, 1.0, 30, 0.0, 0, 250.0)
    assert driver_rows({"adaptive": [half, longer]})[0].think_rate == pytest.approx(0.05), "2 of 40 plans"
    told = drives_to_json({EXPERT: [whole], "adaptive": [half]})["drivers"]
    assert {"name", "episodes", "route_completion", "collisions", "off_road", "think_rate"} <= set(told[1])
    assert told[1]["drives"][0]["ended"] == "collision"
    assert driver_rows({"adaptive": [half]})[0].route_completion is None


JSON_KEYS = {
    *("name", "episodes", "km", "route_completion", "collisions", "collisions_per_km"),
    *("off_road", "off_road_per_km", "jerk_ms3", "lateral_ms2", "think_rate", "plans"),
    *("deadline_misses", "plan_ms", "intervals", "drives"),
}
JSON_DRIVE_KEYS = {
    *("seed", "ended", "driven_m", "off_road", "jerk_ms3", "lateral_ms2", "plans", "thought", "late"),
    *("milliseconds", "hit"),
}
JSON_COMPARISON_KEYS = {
    *("driver", "against", "episodes", "completion_ratio", "collisions_per_km_difference"),
    *("off_road_per_km_difference", "intervals"),
}


def driven(seed: int, driven_m: float, *, collided: bool = False, left: bool = False) -> Drive:
    return Drive(seed, "collision" if collided else "time", driven_m, left, 3.0, 1.0)


def test_json_has_the_keys_that_scripts_rely_on() -> None:
    drives = {
        EXPERT: [driven(1, 400.0), driven(2, 400.0)],
        "never": [driven(1, 300.0, collided=True), driven(2, 200.0, left=True)],
        "adaptive": [driven(1, 400.0), driven(2, 100.0, left=True)],
    }
    told = json.loads(json.dumps(drives_to_json(drives)))
    assert set(told) == {"drivers", "comparisons"}
    assert [driver["name"] for driver in told["drivers"]] == list(drives)
    for driver in told["drivers"]:
        assert set(driver) == JSON_KEYS
        assert set(driver["intervals"]) == {"route_completion", "collisions_per_km", "off_road_per_km"}
        assert [set(each) for each in driver["drives"]] == [JSON_DRIVE_KEYS] * 2
    expert, never, _ = told["drivers"]
    assert (expert["km"], never["km"]) == pytest.approx((0.8, 0.5))
    assert (never["collisions_per_km"], never["off_road_per_km"]) == pytest.approx((2.0, 2.0))
    # With either episode alone: a collision in 0.3 km, or none in 0.2.
    assert never["intervals"]["collisions_per_km"] == pytest.approx([0.0, 1 / 0.3])
    assert never["intervals"]["route_completion"] == pytest.approx([0.5, 0.75])

    assert [set(each) for each in told["comparisons"]] == [JSON_COMPARISON_KEYS] * 2
    _, adaptive = told["comparisons"]
    assert (adaptive["driver"], adaptive["against"], adaptive["episodes"]) == ("adaptive", "never", 2)
    assert adaptive["completion_ratio"] == pytest.approx(1.0)
    assert adaptive["collisions_per_km_difference"] == pytest.approx(-2.0)
    assert adaptive["off_road_per_km_difference"] == pytest.approx(0.0)
    assert {name: pytest.approx(interval) for name, interval in adaptive["intervals"].items()} == {
        "completion_ratio": [0.5, 4 / 3],
        "collisions_per_km_difference": [-1 / 0.3, 0.0],
        "off_road_per_km_difference": [0.0, 1 / 0.1 - 1 / 0.2],
    }


def test_drivers_are_paired_episode_by_episode() -> None:
    never = [driven(seed, 20.0 * seed, collided=seed % 3 == 0) for seed in range(1, 31)]
    further = [replace(each, driven_m=1.25 * each.driven_m) for each in never]
    only_here = driven(31, 1000.0, collided=True)
    (compared,) = driver_comparisons({"adaptive": [*reversed(further), only_here], "never": never})
    assert compared.episodes == 30
    # Episodes differ by much in length, and the two drivers in each of them by a quarter.
    assert compared.completion_ratio == pytest.approx(1.25)
    assert compared.intervals["completion_ratio"] == pytest.approx((1.25, 1.25))
    collided, km = 10, 0.02 * sum(range(1, 31))
    assert compared.collisions_per_km_difference == pytest.approx(collided / (1.25 * km) - collided / km)
    (same,) = driver_comparisons({"never": never, "always": never})
    assert (same.completion_ratio, same.collisions_per_km_difference) == (1.0, 0.0)
    assert same.intervals["collisions_per_km_difference"] == (0.0, 0.0)
    low, high = driver_rows({"never": never})[0].intervals["collisions_per_km"]
    assert high - low > 0.5, "each by itself is far from certain"


def test_all_are_compared_with_who_never_thinks_or_else_with_the_first_that_is_no_limit() -> None:
    def pairs(*names: str) -> list[tuple[str, str]]:
        drives = {name: [driven(1, 100.0)] for name in names}
        return [(each.driver, each.against) for each in driver_comparisons(drives)]

    limits = (EXPERT, ConstantVelocity.name)
    assert pairs(*limits) == []
    assert pairs("never") == []
    assert pairs(EXPERT, "adaptive", "never") == [(EXPERT, "never"), ("adaptive", "never")]
    assert pairs(EXPERT, "teacher a", "teacher b") == [(EXPERT, "teacher a"), ("teacher b", "teacher a")]


def test_nothing_is_told_of_drivers_that_cannot_be_compared() -> None:
    assert driver_comparisons({"never": [driven(1, 100.0)], "adaptive": [driven(2, 100.0)]}) == []
    (stood,) = driver_comparisons({"never": [driven(1, 100.0)], "adaptive": [driven(1, 0.0)]})
    assert (stood.completion_ratio, stood.collisions_per_km_difference) == (0.0, None)
    assert set(stood.intervals) == {"completion_ratio"}
    (against,) = driver_comparisons({"never": [driven(1, 0.0)], "adaptive": [driven(1, 100.0)]})
    assert (against.completion_ratio, against.off_road_per_km_difference) == (None, None)
    assert against.intervals == {}
    assert format_driver_rows([], [against]).split()[-5:] == ["never", "1", "-", "-", "-"]


def test_comparisons_stand_below_the_rows() -> None:
    drives = {
        "never": [driven(1, 300.0, collided=True), driven(2, 200.0)],
        "adaptive": [driven(1, 400.0), driven(2, 100.0)],
    }
    rows, comparisons = driver_rows(drives), driver_comparisons(drives)
    text = format_driver_rows(rows, comparisons)
    assert text.startswith(format_driver_rows(rows) + "\n\n")
    title, line = text.splitlines()[-2:]
    assert title.split("  ")[-1] == "95 %"
    pair, *figures = re.split(" {2,}", line)
    assert pair == "adaptive : never"
    assert figures == ["2", "1.00", "0.50..1.33", "-2.00", "-3.33..+0.00", "+0.00", "+0.00..+0.00"]


def test_a_run_that_was_cut_goes_on_behind_what_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "drives.jsonl"
    whole = Drive(1, "time", 200.0, False, 3.0, 1.0)
    half = Drive(2, "collision", 100.0, True, 5.0, 2.0, 10, 0.2, 1, 250.0)
    stored = drive_store(file)
    stored.store("a", whole)
    stored.store("b", half)
    text = file.read_text()
    file.write_text(text[:-20])  # killed while it wrote
    again = drive_store(file)
    assert again.find("a") == whole
    assert again.find("b") is None
    again.store("b", half)
    assert file.read_text() == text
    assert drive_store(file).find("b") == half
