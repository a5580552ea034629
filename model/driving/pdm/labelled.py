"""The world of a labelled scene of our own, as far as it is known there."""

from __future__ import annotations

from typing import Final

import numpy as np

from model.driving.agents import Agent
from model.driving.pdm.world import (
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
    TrackedBox,
    Vehicle,
    World,
    X,
    Y,
)
from model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, LabelledScene
from model.driving.trajectory import HISTORY_STEPS, FloatArray

_AXLE_M: Final = 1.4166
"""From the box's centre back to the rear axle, in MetaDrive's car; 1.0523 m forward to the front one."""
EGO: Final = Vehicle(EGO_WIDTH_M, EGO_LENGTH_M / 2 + _AXLE_M, EGO_LENGTH_M / 2 - _AXLE_M, _AXLE_M + 1.0523)
"""The ego of our scenes."""
_MOVING_MPS: Final = 0.5


def world_of(labelled: LabelledScene) -> World:
    """The world around a labelled scene's ego, whose poses are those of the box's centre.

    Our scenes know no lanes as areas, no intersections and no lights: those layers are None. The centre line
    is the route, where there is one.
    """
    past = _states(labelled.scene.history)
    route = labelled.scene.route
    line = None if route is None else np.concatenate([np.zeros((1, 2)), route.astype(np.float64)])
    drivable = (
        Area(tuple(ring.astype(np.float64) for ring in labelled.drivable)) if labelled.drivable else None
    )
    return World(
        ego=past[-1],
        vehicle=EGO,
        tracks=tuple(_track(agent) for agent in labelled.agents if np.isfinite(_ahead(agent)).any()),
        drivable=None if drivable is None else (drivable,),
        centreline=line,
        past=past[:-1],
    )


def plans_of(trajectories: FloatArray) -> Array:
    """Trajectories [n, 64, 4] as plans [n, 64, 3] of the box's centre."""
    return trajectories[..., [0, 1, 3]].astype(np.float64)


def _states(history: FloatArray) -> Array:
    """States [16, 11] of the rear axle, of poses [16, 4] of the centre at 10 Hz."""
    states = np.zeros((HISTORY_STEPS, STATE_SIZE))
    heading = np.unwrap(history[:, 3].astype(np.float64))
    axle = history[:, :2] - EGO.centre_m * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    steps = np.gradient(axle, STEP_S, axis=0)
    speed = steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading)
    turning = np.gradient(heading, STEP_S)
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
    is_agent = agent.kind in ("vehicle", "pedestrian")
    return TrackedBox(
        str(agent.agent_id), is_agent, agent.length_m, agent.width_m, poses, first_speed_mps(poses)
    )


def first_speed_mps(poses: Array) -> float:
    """The speed of a track [t, 3] at 10 Hz when it is first seen; 0 where it is seen once only."""
    first = int(np.isfinite(poses[:, 0]).argmax())
    step = poses[first + 1 : first + 2, :2] - poses[first, :2]
    return float(np.hypot(*step[0]) / STEP_S) if len(step) and np.isfinite(step).all() else 0.0
