from __future__ import annotations

import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from looktwice.clients import wire
from looktwice.clients.navsim.agent import NavsimMissing, NavsimPlanner, make_agent
from looktwice.clients.navsim.agent_input import InputError
from looktwice.clients.navsim.history import history_of
from looktwice.clients.navsim.reprojection import seen_as
from looktwice.clients.planner import PlannerClient
from looktwice.model.driving.cameras import FRONT_CAMERAS
from looktwice.model.driving.images import check_image
from looktwice.model.driving.trajectory import agreed
from looktwice.service.operations.settings import Settings
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve

WIDE, TELE = FRONT_CAMERAS
FOCAL_PX, SIZE = 386.25, (480, 270)
"""A quarter of what NAVSIM's cameras have."""
LEFT = 55.0
BENT = np.array([-0.356, 0.173, -0.0002, 0.0001, -0.052])


@dataclass
class Camera:
    image: npt.NDArray[np.uint8] | None
    sensor2lidar_rotation: npt.NDArray[np.float64] | None
    intrinsics: npt.NDArray[np.float64] | None
    distortion: npt.NDArray[np.float64] | None


@dataclass
class Cameras:
    cam_f0: Camera
    cam_l0: Camera
    cam_r0: Camera


@dataclass
class EgoStatus:
    ego_pose: npt.NDArray[np.float64]
    ego_velocity: npt.NDArray[np.float64]


@dataclass
class AgentInput:
    ego_statuses: list[EgoStatus]
    cameras: list[Cameras]


def camera(heading_degrees: float, distortion: npt.NDArray[np.float64] | None = None) -> Camera:
    """A camera that shows each direction's heading in red, and whether it is above the horizon in green."""
    turn = np.radians(heading_degrees)
    ahead = np.array([np.cos(turn), np.sin(turn), 0.0])
    right = np.array([np.sin(turn), -np.cos(turn), 0.0])
    rotation = np.stack([right, [0.0, 0.0, -1.0], ahead], axis=1)
    width, height = SIZE
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    x, y = u / FOCAL_PX, v / FOCAL_PX
    if distortion is not None:
        bent_x, bent_y = x, y
        for _ in range(60):
            square = x * x + y * y
            radial = 1 + square * (distortion[0] + square * (distortion[1] + square * distortion[4]))
            x = (bent_x - 2 * distortion[2] * x * y - distortion[3] * (square + 2 * x * x)) / radial
            y = (bent_y - distortion[2] * (square + 2 * y * y) - 2 * distortion[3] * x * y) / radial
    directions = np.stack([x, y, np.ones_like(x)], axis=-1) @ rotation.T
    heading = np.degrees(np.arctan2(directions[..., 1], directions[..., 0]))
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.clip(128 + heading, 0, 255)
    image[..., 1] = np.where(directions[..., 2] > 0, 200, 50)
    intrinsics = np.array([[FOCAL_PX, 0, width / 2], [0, FOCAL_PX, height / 2], [0, 0, 1.0]])
    return Camera(image, rotation, intrinsics, distortion)


def rig(distortion: npt.NDArray[np.float64] | None = None) -> Cameras:
    return Cameras(camera(0.0, distortion), camera(LEFT, distortion), camera(-LEFT, distortion))


def agent_input(speed_mps: float = 6.0, yaw_rate: float = 0.25) -> AgentInput:
    """On an arc, as NAVSIM tells it: seen from the present, velocities each in their own frame."""
    statuses = []
    for seconds in (-1.5, -1.0, -0.5, 0.0):
        heading = yaw_rate * seconds
        place = speed_mps / yaw_rate * np.array([np.sin(heading), 1 - np.cos(heading)])
        statuses.append(EgoStatus(np.array([*place, heading]), np.array([speed_mps, 0.0])))
    return AgentInput(statuses, [rig() for _ in range(4)])


def test_the_history_follows_the_arc_between_the_poses() -> None:
    history = history_of(agent_input().ego_statuses)
    heading = 0.25 * 0.1 * np.arange(-15, 1)
    np.testing.assert_allclose(history[:, 0], 24 * np.sin(heading), atol=1e-3)
    np.testing.assert_allclose(history[:, 1], 24 * (1 - np.cos(heading)), atol=1e-3)
    np.testing.assert_allclose(history[:, 3], heading, atol=1e-3)
    assert not history[-1].any()
    assert not history[:, 2].any()


def test_poses_in_another_frame_give_the_same_history() -> None:
    statuses = agent_input().ego_statuses
    expected = history_of(statuses)
    turn = 2.5
    for status in statuses:
        x, y, heading = status.ego_pose
        moved = [np.cos(turn) * x - np.sin(turn) * y + 1e3, np.sin(turn) * x + np.cos(turn) * y - 7.0]
        status.ego_pose = np.array([*moved, heading + turn])
    np.testing.assert_allclose(history_of(statuses), expected, atol=1e-4)


@pytest.mark.parametrize("distortion", [None, BENT])
@pytest.mark.parametrize("spec", FRONT_CAMERAS)
def test_a_view_shows_each_direction_where_it_belongs(
    spec: Any, distortion: npt.NDArray[np.float64] | None
) -> None:
    cameras = rig(distortion)
    view = seen_as(spec, (cameras.cam_f0, cameras.cam_l0, cameras.cam_r0)).astype(float)
    horizon = round(spec.horizon * spec.height)
    row = view[horizon + 4]
    columns = np.arange(spec.width) + 0.5
    expected = np.degrees(np.arctan2(spec.width / 2 - columns, spec.focal_px))
    np.testing.assert_allclose(row[:, 0] - 128, expected, atol=1.5)
    # Sky above, road below, also where the pictures end.
    assert (view[: horizon - 2, :, 1] > 150).all()
    assert (view[horizon + 2 :, :, 1] < 100).all()


def test_what_no_camera_sees_is_grey() -> None:
    view = seen_as(WIDE, (rig().cam_f0,))
    assert (view[:, :20] == 128).all()
    assert (view[:, -20:] == 128).all()


def test_eight_poses_are_those_of_the_draw_that_the_others_agree_with() -> None:
    engine = ScriptedEngine()
    with serve(engine, Settings()) as served, PlannerClient(served.url) as client:
        planner = NavsimPlanner(client, wire.Controls(n=5, seed=4))
        poses = planner.poses(agent_input())
        NavsimPlanner(client, wire.Controls(n=5, seed=4)).poses(agent_input())
        NavsimPlanner(client, wire.Controls(n=5, seed=5)).poses(agent_input())
        moving = agent_input()
        moving.ego_statuses[-1].ego_velocity[0] += 1.0
        planner.poses(moving)
        seeds = [request.controls.seed for request in engine.submitted]
        again = client.plan(planner.scene(agent_input()), wire.Controls(n=5, seed=seeds[0]))
    draws = np.stack([draw.trajectory for draw in again.draws])
    driven = draws[agreed(draws)]
    assert poses.shape == (8, 3)
    assert poses.dtype == np.float32
    np.testing.assert_array_equal(poses, driven[[4, 9, 14, 19, 24, 29, 34, 39]][:, [0, 1, 3]])
    asked = engine.submitted[0]
    assert seeds[:3] == [seeds[0], seeds[0], seeds[0] + 1], "the input decides, and the seed given"
    assert seeds[3] not in seeds[:3]
    assert [clip.camera for clip in asked.scene.clips] == ["front_wide_120", "front_tele_30"]
    assert check_image(asked.scene.clips[0].images[0]) == (224, 128)
    assert asked.scene.route is None


def test_a_camera_that_was_not_loaded_is_missed() -> None:
    given = agent_input()
    given.cameras[2].cam_l0.image = None
    engine = ScriptedEngine()
    with serve(engine, Settings()) as served, PlannerClient(served.url) as client:
        with pytest.raises(InputError, match="cam_l0"):
            NavsimPlanner(client).poses(given)
        with pytest.raises(InputError, match="four instants"):
            NavsimPlanner(client).poses(AgentInput(given.ego_statuses, given.cameras[:1]))
    with pytest.raises(InputError, match="four ego statuses"):
        history_of(given.ego_statuses[1:])


def test_without_navsim_the_agent_says_what_is_missing() -> None:
    with pytest.raises(NavsimMissing, match=r"NavsimPlanner\.poses"):
        make_agent()


@dataclass
class SensorConfig:
    cam_f0: bool
    cam_l0: bool
    cam_r0: bool
    lidar_pc: bool

    @classmethod
    def build_no_sensors(cls) -> SensorConfig:
        return cls(False, False, False, False)


@dataclass
class TrajectorySampling:
    num_poses: int
    interval_length: float


@dataclass
class Trajectory:
    poses: npt.NDArray[np.float32]
    trajectory_sampling: TrajectorySampling

    def __post_init__(self) -> None:
        assert self.poses.shape == (self.trajectory_sampling.num_poses, 3)


class AgentOfTwo:
    def __init__(self, trajectory_sampling: TrajectorySampling, requires_scene: bool = False) -> None:
        self.requires_scene = requires_scene
        self._trajectory_sampling = trajectory_sampling


class AgentOfOne:
    def __init__(self, requires_scene: bool = False) -> None:
        assert isinstance(requires_scene, bool)
        self.requires_scene = requires_scene


@pytest.mark.parametrize("base", [AgentOfOne, AgentOfTwo])
def test_inside_navsim_it_is_an_agent(base: type[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """NAVSIM pins a Python and packages of its own: its names stand in for it here."""
    modules: dict[str, dict[str, type[Any]]] = {
        "navsim.agents.abstract_agent": {"AbstractAgent": base},
        "navsim.common.dataclasses": {"SensorConfig": SensorConfig, "Trajectory": Trajectory},
        "nuplan.planning.simulation.trajectory.trajectory_sampling": {
            "TrajectorySampling": TrajectorySampling
        },
    }
    for name, members in modules.items():
        module = ModuleType(name)
        for member_name, member in members.items():
            setattr(module, member_name, member)
        parts = name.split(".")
        for length in range(1, len(parts)):
            monkeypatch.setitem(sys.modules, ".".join(parts[:length]), ModuleType(".".join(parts[:length])))
        monkeypatch.setitem(sys.modules, name, module)
    with serve(ScriptedEngine(), Settings()) as served:
        agent: Any = make_agent(served.url, n=2)
        agent.initialize()
        trajectory = agent.compute_trajectory(agent_input())
        agent.close()
    assert base in type(agent).__mro__
    assert not agent.requires_scene
    assert agent.name() == "looktwice"
    assert agent.get_sensor_config() == SensorConfig(True, True, True, False)
    assert isinstance(trajectory, Trajectory)
    assert trajectory.trajectory_sampling == TrajectorySampling(8, 0.5)
