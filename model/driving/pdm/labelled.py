"""The world of a labelled scene of our own, as far as it is known there."""

from __future__ import annotations

from typing import Final

import numpy as np

from looktwice.model.driving.agents import ROAD_USERS, Agent
from looktwice.model.driving.lane_map import LaneArea
from looktwice.model.driving.pdm.plan_simulator import reference_poses, simulate
from looktwice.model.driving.pdm.world import (
    ACCELERATION,
    HEADING,
    LONG_STEPS,
    SPEED,
    STATE_SIZE,
    STEERING,
    STEP_S,
    YAW_RATE,
    Area,
    Array,
    EgoVehicle,
    Lane,
    TrackedBox,
    World,
    X,
    Y,
)
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, LabelledScene
from looktwice.model.driving.trajectory import HISTORY_STEPS, FloatArray, to_ego_frame

_WHEELBASE_M: Final = 1.4166 + 1.0523
"""Of MetaDrive's car, behind and before its middle."""
EGO: Final = EgoVehicle(EGO_WIDTH_M, EGO_LENGTH_M / 2, EGO_LENGTH_M / 2, _WHEELBASE_M)
"""The ego of our scenes, measured from its middle: that is the point that never slips.

Experts on their rails, and cars that follow plans (`looktwice.clients.metadrive`), head where their
middle goes. NAVSIM calls the point of which this is true the rear axle. Were it put where MetaDrive's axle
is, an expert in a tight turn would slip by 8 degrees there, and NAVSIM's tracker, which cannot slip, be a
metre off.
"""
_MOVING_MPS: Final = 0.5


def world_of(labelled: LabelledScene) -> World:
    """The world around a labelled scene's ego, whose poses are those of the box's centre.

    A scene without a lane map knows no lanes as areas, no intersections and no lights: those layers are None,
    and the centre line is the route, where there is one.
    """
    past = past_states(labelled.scene.history)
    known = labelled.lane_map
    return World(
        ego=past[-1],
        vehicle=EGO,
        tracks=tuple(_track(agent) for agent in labelled.agents if np.isfinite(_ahead(agent)).any()),
        lanes=None if known is None else tuple(map(_lane, known.lanes)),
        intersections=None if known is None else areas_of_rings(known.intersections),
        drivable=areas_of_rings(labelled.drivable) or None,
        # A world without lights has none that is red, and that is known. Of a world with lights it is not.
        lights=None if known is None or known.has_lights else (),
        centreline=route_line(labelled.scene.route) if known is None else known.centreline.astype(np.float64),
        past=past[:-1],
    )


def _lane(lane: LaneArea) -> Lane:
    return Lane(str(lane.lane_id), Area((lane.ring.astype(np.float64),)), lane.on_route)


def areas_of_rings(rings: tuple[FloatArray, ...]) -> tuple[Area, ...]:
    """One area of all rings, as points are in it by the even-odd rule; none of none."""
    return (Area(tuple(ring.astype(np.float64) for ring in rings)),) if rings else ()


def route_line(route: FloatArray | None) -> Array | None:
    """A route [20, 2] as a centre line [21, 2] from the ego on; None without one."""
    return None if route is None else np.concatenate([np.zeros((1, 2)), route.astype(np.float64)])


def states_of(history: FloatArray, plan: Array) -> Array:
    """Simulated states [41, 11] of a plan [64, 3] of the centre that begins where a history [h, 4] ends."""
    state = past_states(history)[-1]
    states: Array = simulate(reference_poses(plan[None], EGO, state, centre=True), EGO, state)[0]
    return states


def moment_before(labelled: LabelledScene, seconds: float) -> tuple[FloatArray, FloatArray]:
    """The scene's ego a little earlier: its history [h, 4] up to then, and the expert's way on [64, 4].

    The history is as much shorter as the moment lies back; at least four of its 16 poses must be left.
    """
    back = round(seconds / STEP_S)
    track = np.concatenate([labelled.scene.history, labelled.future]).astype(np.float64)
    present = HISTORY_STEPS - 1 - back
    seen = to_ego_frame(track, track[present]).astype(np.float32)
    return seen[: present + 1], seen[present + 1 : present + 1 + len(labelled.future)]


def plans_of(trajectories: FloatArray) -> Array:
    """Trajectories [..., 4] as plans [..., 3] of the box's centre."""
    return trajectories[..., [0, 1, 3]].astype(np.float64)


def past_states(history: FloatArray) -> Array:
    """States [h, 11] of the rear axle, of poses [h, 4] of the centre at 10 Hz.

    At both ends, speeds and turns are those of the parabola through the three nearest poses. A plain
    difference would be half a step late, and the acceleration now, taken of it, half of what it is.
    """
    states = np.zeros((len(history), STATE_SIZE))
    heading = np.unwrap(history[:, 3].astype(np.float64))
    axle = history[:, :2] - EGO.centre_m * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    steps = np.gradient(axle, STEP_S, axis=0, edge_order=2)
    speed = steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading)
    turning = np.gradient(heading, STEP_S, edge_order=2)
    moving = np.where(np.abs(speed) > _MOVING_MPS, speed, np.inf)
    states[:, X], states[:, Y], states[:, HEADING] = axle[:, 0], axle[:, 1], heading
    states[:, SPEED], states[:, YAW_RATE] = speed, turning
    states[:, ACCELERATION] = np.gradient(speed, STEP_S)
    states[:, STEERING] = np.arctan(turning * EGO.wheelbase_m / moving)
    return states


def _ahead(agent: Agent) -> FloatArray:
    return agent.poses[HISTORY_STEPS - 1 : HISTORY_STEPS + LONG_STEPS]


def _track(agent: Agent) -> TrackedBox:
    poses = _ahead(agent).astype(np.float64)
    is_agent = agent.kind in ROAD_USERS
    return TrackedBox(
        str(agent.agent_id),
        is_agent,
        agent.length_m,
        agent.width_m,
        poses,
        first_speed_mps(poses),
        agent.kind,
    )


def first_speed_mps(poses: Array) -> float:
    """The speed of a track [t, 3] at 10 Hz when it is first seen; 0 where it is seen once only."""
    first = int(np.isfinite(poses[:, 0]).argmax())
    step = poses[first + 1 : first + 2, :2] - poses[first, :2]
    return float(np.hypot(*step[0]) / STEP_S) if len(step) and np.isfinite(step).all() else 0.0
