"""A car that follows planned trajectories: a kinematic bicycle with a driver's limits, for many at once.

The simulator's car (`looktwice.clients.metadrive.world.tracking`) has the same limits, and moves one step of
one trajectory at a time. This one begins at the origin of the trajectories' frame and sees nobody.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.pdm import world as pdm
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M
from looktwice.model.driving.trajectory import FUTURE_STEPS, STEP_S, FloatArray

WHEELBASE_M: Final = 2.8
MAX_STEER_RAD: Final = 0.6
STEER_RATE: Final = 0.8
ACCELERATION: Final = (-7.0, 3.0)
JERK: Final = 15.0
SPEED_AHEAD_S: Final = 0.5
"""It takes the speed that the trajectory has so much later, and makes up ..."""
CATCH_UP: Final = 0.4
"""... for ground that it lost or gained, m/s² a metre."""
LOOK_AHEAD_S: Final = 0.6
LOOK_AHEAD_M: Final = 3.0
"""It steers for a point this far ahead, and so many seconds farther: pure pursuit."""

CAR: Final = pdm.EgoVehicle(EGO_WIDTH_M, EGO_LENGTH_M / 2, EGO_LENGTH_M / 2, WHEELBASE_M)
"""Measured from its centre, as all our poses are."""

Array = npt.NDArray[np.float64]


class Rides(NamedTuple):
    """Where cars came that followed k trajectories.

    Attributes:
        poses: x, y and heading [k, 64, 3], in the trajectories' frame; the first at +0.1 s.
        speeds_ms: [k, 64], signed.
    """

    poses: Array
    speeds_ms: Array


def follow_all(trajectories: FloatArray, speed_ms: float, acceleration_ms2: float) -> Rides:
    """Follow trajectories [k, 64, 4] from the origin of their frame, each by a car of its own.

    Args:
        trajectories: as planners write them.
        speed_ms, acceleration_ms2: of the car now.
    """
    way = _ways(trajectories, speed_ms)
    rows, count = np.arange(len(way)), len(way)
    x, y, heading, steer = (np.zeros(count) for _ in range(4))
    speed, acceleration = np.full(count, speed_ms), np.full(count, acceleration_ms2)
    poses, speeds_ms = np.empty((count, FUTURE_STEPS, 3)), np.empty((count, FUTURE_STEPS))
    later = round(SPEED_AHEAD_S / STEP_S)
    for step in range(FUTURE_STEPS):
        due, ahead = way[:, step], way[:, min(step + later, FUTURE_STEPS)]
        wanted = (ahead[:, 3] - speed) / SPEED_AHEAD_S
        wanted += CATCH_UP * ((due[:, 0] - x) * np.cos(heading) + (due[:, 1] - y) * np.sin(heading))
        change = np.clip(wanted - acceleration, -JERK * STEP_S, JERK * STEP_S)
        faster = speed + STEP_S * np.clip(acceleration + change, *ACCELERATION)
        faster = np.where((speed >= 0) & (faster < 0), 0.0, faster)
        # Where the rest of a trajectory lies within reach, the car stands, or nearly so, and steers on.
        off_x, off_y = way[:, step:, 0] - x[:, None], way[:, step:, 1] - y[:, None]
        apart = np.hypot(off_x, off_y)
        beyond = apart >= (LOOK_AHEAD_M + LOOK_AHEAD_S * np.abs(speed))[:, None]
        aim = beyond.argmax(axis=1)
        left = off_y[rows, aim] * np.cos(heading) - off_x[rows, aim] * np.sin(heading)
        reach = np.where(beyond.any(axis=1), apart[rows, aim], np.inf)
        pursued = np.where(np.isfinite(reach), np.arctan2(2 * WHEELBASE_M * left, reach**2), steer)
        pursued = np.clip(pursued, -MAX_STEER_RAD, MAX_STEER_RAD)
        steer = steer + np.clip(pursued - steer, -STEER_RATE * STEP_S, STEER_RATE * STEP_S)
        driven_m = 0.5 * (speed + faster) * STEP_S
        turned = driven_m * np.tan(steer) / WHEELBASE_M
        x = x + driven_m * np.cos(heading + 0.5 * turned)
        y = y + driven_m * np.sin(heading + 0.5 * turned)
        heading = heading + turned
        acceleration, speed = (faster - speed) / STEP_S, faster
        poses[:, step] = np.stack([x, y, heading], axis=1)
        speeds_ms[:, step] = speed
    return Rides(poses, speeds_ms)


def ride_states(poses: Array, speeds_ms: Array) -> Array:
    """Rides [k, t, 3] as NAVSIM's states [k, t, 11]; a turn makes the sideways acceleration at that speed."""
    states = np.zeros((*speeds_ms.shape, pdm.STATE_SIZE))
    states[..., pdm.X], states[..., pdm.Y], states[..., pdm.HEADING] = np.moveaxis(poses, -1, 0)
    yaw_rate = _rate(poses[..., 2])
    states[..., pdm.SPEED], states[..., pdm.ACCELERATION] = speeds_ms, _rate(speeds_ms)
    states[..., pdm.ACCELERATION_Y] = yaw_rate * speeds_ms
    states[..., pdm.YAW_RATE], states[..., pdm.YAW_ACCELERATION] = yaw_rate, _rate(yaw_rate)
    return states


def _rate(values: Array) -> Array:
    """Backward differences of [k, t]; the first is the second's."""
    rate = np.diff(values, axis=1) / STEP_S
    return np.concatenate([rate[:, :1], rate], axis=1)


def _ways(trajectories: FloatArray, speed_ms: float) -> Array:
    """x, y, heading and speed [k, 65, 4] of trajectories, from where the car is now on."""
    way = np.zeros((len(trajectories), FUTURE_STEPS + 1, 4))
    way[:, 0, 3] = speed_ms
    way[:, 1:, :2], way[:, 1:, 2] = trajectories[..., :2], trajectories[..., 3]
    step = np.diff(way[..., :2], axis=1)
    heading = way[:, 1:, 2]
    way[:, 1:, 3] = (step[..., 0] * np.cos(heading) + step[..., 1] * np.sin(heading)) / STEP_S
    return way
