"""What a filmed episode's scenes promise."""

from __future__ import annotations

import io
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely
from PIL import Image

from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.scenes.windows import labelled_scenes
from looktwice.clients.metadrive.world.episode import run_episode
from looktwice.clients.metadrive.world.maps import make_map
from looktwice.clients.metadrive.world.y_flip import points_from_metadrive
from looktwice.model.driving.cameras import FRONT_CAMERAS, SURROUND_CAMERAS, CameraSpec
from looktwice.model.driving.metrics import collides, leaves_road
from looktwice.model.driving.scene import CAMERAS, EGO_LENGTH_M, SEMANTIC_CLASSES, LabelledScene
from tests.clients.metadrive.conftest import DURATION_S, SEED, Filmed


def test_every_half_second_with_a_whole_past_and_future_becomes_a_scene(filmed: Filmed) -> None:
    steps = [int(labelled.scene.scene_id.split("-")[1]) for labelled in filmed.scenes]
    assert steps
    assert steps[0] == 15
    assert set(np.diff(steps)) == {5}
    assert steps[-1] + 64 < len(filmed.log.ego)


def test_the_same_seed_drives_and_films_the_same_episode(filmed: Filmed, rig: Rig) -> None:
    again = run_episode(SEED, DURATION_S)
    assert np.array_equal(again.ego, filmed.log.ego)
    assert [actor.actor_id for actor in again.actors] == [actor.actor_id for actor in filmed.log.actors]
    first = next(labelled_scenes(again, rig, 0.5))
    assert first.scene.clips == filmed.scenes[0].scene.clips
    assert first.tags == filmed.scenes[0].tags


def test_next_frames_are_what_the_scene_half_a_second_later_shows(filmed: Filmed, rig: Rig) -> None:
    first = next(labelled_scenes(filmed.log, rig, 1.0, with_dense=False, with_next=True))
    assert not any(labelled.next_frames for labelled in filmed.scenes)
    assert first.scene.scene_id == filmed.scenes[0].scene.scene_id
    later = filmed.scenes[1].scene
    assert later.scene_id.endswith("-0020")
    told = {frame.camera: frame.image for frame in first.next_frames}
    assert told == {clip.camera: clip.images[-1] for clip in later.clips}


def test_other_seeds_drive_elsewhere(filmed: Filmed) -> None:
    other = run_episode(SEED + 1, 3.0)
    assert not np.allclose(other.ego[:20], filmed.log.ego[:20])


def test_nobody_hits_anything_or_leaves_the_road(filmed: Filmed) -> None:
    for labelled in filmed.scenes:
        assert not collides(labelled.future[None], labelled.agents, 6.4)[0]
        assert not leaves_road(labelled.future[None], labelled.drivable)[0]


def test_history_and_future_join_at_the_present(filmed: Filmed) -> None:
    for labelled in filmed.scenes:
        assert np.abs(labelled.scene.history[-1]).max() < 1e-6
        step = labelled.future[0, 0] - labelled.scene.history[-2, 0]
        assert abs(step / 2 - labelled.future[0, 0]) < 0.05


def test_the_route_starts_ahead_and_is_evenly_spaced(filmed: Filmed) -> None:
    for labelled in filmed.scenes:
        assert labelled.scene.route is not None
        route = np.concatenate([np.zeros((1, 2)), labelled.scene.route])
        assert np.allclose(np.hypot(*np.diff(route[1:], axis=0).T), 4.0, atol=0.15)
        assert route[1, 0] > 0
        area = _area(labelled)
        assert all(area.distance(shapely.Point(point)) < 0.5 for point in route[1:])


def test_pictures_have_the_asked_size(filmed: Filmed) -> None:
    for clip, spec in zip(filmed.scenes[0].scene.clips, FRONT_CAMERAS, strict=True):
        assert clip.camera == spec.name
        for jpeg in clip.images:
            with Image.open(io.BytesIO(jpeg)) as picture:
                assert picture.size == (spec.width, spec.height)


def test_lane_trace_says_where_the_ego_is(filmed: Filmed) -> None:
    for labelled in filmed.scenes:
        assert labelled.lane_trace is not None
        assert (labelled.lane_trace.lane >= 0).all()
        assert np.abs(labelled.lane_trace.offset_m).max() < 2.2


def test_metadrives_right_is_our_negative_y() -> None:
    assert points_from_metadrive([(3.0, 2.0)]).tolist() == [[3.0, -2.0]]


def test_lane_zero_is_the_leftmost_in_our_frame() -> None:
    road_map = make_map(SEED, 300.0)
    for road in road_map.roads:
        lanes = [road_map.lanes[lane] for lane in road.lanes]
        for left, right in pairwise(lanes):
            heading = left.centre[1] - left.centre[0]
            side = right.centre[0] - left.centre[0]
            assert heading[0] * side[1] - heading[1] * side[0] < 0


def test_left_in_the_world_is_left_in_the_picture(filmed: Filmed) -> None:
    """Dense targets show vehicles on the side where their boxes are."""
    checked = 0
    for labelled in filmed.scenes:
        for spec, target in zip(FRONT_CAMERAS, labelled.dense, strict=True):
            for agent in labelled.agents:
                x, y, _ = agent.present
                if agent.kind != "vehicle" or not np.isfinite(x) or not 10 < x < 25 or abs(y) < 2:
                    continue
                column, row, _ = spec.project(np.array([[x, y, agent.height_m / 2]]))[0]
                if 4 < column < spec.width - 4 and 4 < row < spec.height - 4:
                    down, across = int(row) // 4, int(column) // 4
                    around = target.classes[down - 1 : down + 2, across - 1 : across + 2]
                    assert (around == SEMANTIC_CLASSES.index("vehicle")).any()
                    assert (column < spec.width / 2) == (y > 0)
                    checked += 1
    assert checked


def test_dense_targets_agree_with_boxes_and_road(filmed: Filmed) -> None:
    for labelled in filmed.scenes[::4]:
        area = _area(labelled)
        for spec, target in zip(FRONT_CAMERAS, labelled.dense, strict=True):
            assert target.classes.shape == (28, 56)
            sky = target.classes == SEMANTIC_CLASSES.index("sky")
            assert np.array_equal(sky, target.range_m == 0)
            assert sky[: int(28 * spec.horizon) - 2].any()
            assert not sky[int(28 * spec.horizon) + 2 :].any()
            rows, columns = np.nonzero(target.classes == SEMANTIC_CLASSES.index("road"))
            metres = target.range_m[rows, columns]
            points = spec.unproject(columns * 4 + 2.5, rows * 4 + 2.5, metres)
            near = metres < 40
            assert np.abs(points[near, 2]).max() < 0.3
            assert shapely.contains_xy(area.buffer(0.3), points[near, 0], points[near, 1]).all()


def test_the_lead_vehicle_tag_means_a_vehicle_ahead(filmed: Filmed) -> None:
    for labelled in filmed.scenes:
        if "lead_vehicle" in labelled.tags:
            assert any(agent.kind == "vehicle" and 0 < agent.present[0] < 42 for agent in labelled.agents)


def test_agents_are_boxes_outside_the_ego(filmed: Filmed) -> None:
    for labelled in filmed.scenes:
        for agent in labelled.agents:
            distance = np.hypot(agent.present[0], agent.present[1])
            assert not distance < EGO_LENGTH_M / 4


def test_projection_and_its_inverse_agree() -> None:
    for spec in (*FRONT_CAMERAS, *SURROUND_CAMERAS):
        assert spec.name in CAMERAS
        turn = np.radians(spec.heading_degrees)
        point = np.array([[20 * np.cos(turn), 20 * np.sin(turn), 0.7]])
        column, row, depth = spec.project(point)[0]
        assert np.allclose(spec.unproject(column, row, depth), point[0])


@pytest.mark.parametrize("spec", FRONT_CAMERAS)
def test_the_horizon_lies_where_the_camera_says(spec: CameraSpec) -> None:
    _, row, _ = spec.project(np.array([[1e7, 0.0, spec.up_m]]))[0]
    assert row == pytest.approx(spec.horizon * spec.height, abs=0.01)


def _area(labelled: LabelledScene) -> Any:
    area: Any = shapely.Polygon()
    for ring in labelled.drivable:
        area = area.symmetric_difference(shapely.Polygon(ring).buffer(0))
    return area
