"""How a car would drive along plans: nuPlan's tracker and its kinematic bicycle, all plans at once.

Source: nuplan-devkit's LQR tracker and kinematic bicycle with the constants that NAVSIM gives them.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from looktwice.model.driving.pdm.profiles import profiles, wrapped
from looktwice.model.driving.pdm.world import (
    ACCELERATION,
    HEADING,
    SPEED,
    STATE_SIZE,
    STEERING,
    STEERING_RATE,
    STEP_S,
    STEPS,
    YAW_ACCELERATION,
    YAW_RATE,
    Array,
    EgoVehicle,
    ScoreError,
    X,
    Y,
)

HORIZON: Final = 10
"""Steps that the tracker looks ahead."""
SPEED_WEIGHT: Final = 10.0
OFFSET_WEIGHT: Final = 1.0
HEADING_WEIGHT: Final = 10.0
STOPPING_MPS: Final = 0.2
"""Slower than this, and meant to be, the car is brought to a stop without the tracker."""
STOPPING_GAIN: Final = 0.5
ACCELERATION_LAG_S: Final = 0.2
STEERING_LAG_S: Final = 0.05
MAX_STEERING_RAD: Final = np.pi / 3

_REACH_S: Final = HORIZON * STEP_S
_SPEED_GAIN: Final = -_REACH_S * SPEED_WEIGHT / (_REACH_S * SPEED_WEIGHT * _REACH_S + 1.0)
_UNTIL_S: Final = np.arange(HORIZON)[:, None] * STEP_S
_ACCELERATION_SHARE: Final = STEP_S / (STEP_S + ACCELERATION_LAG_S)
_STEERING_SHARE: Final = STEP_S / (STEP_S + STEERING_LAG_S)
_PLANS: Final = {8: 0.5, 64: 0.1}
"""Poses of a plan, and the seconds between them."""


def reference_poses(plans: Array, vehicle: EgoVehicle, ego: Array, *, centre: bool = False) -> Array:
    """Plans as poses of the rear axle at each simulated step.

    Args:
        plans: [n, 8, 3] at 0.5 s or [n, 64, 3] at 0.1 s: x, y, heading in the world's frame.
        vehicle: the ego's body.
        ego: [11], the state now, which begins each plan.
        centre: whether the poses are those of the box's centre instead of the rear axle.

    Returns:
        [n, 41, 3], row 0 is now.

    Raises:
        ScoreError: a plan of another length, or with values that are not finite.
    """
    if plans.ndim != 3 or plans.shape[1] not in _PLANS or plans.shape[2] != 3:
        raise ScoreError(
            "plans", f"a plan is 8 poses at 0.5 s or 64 at 0.1 s (x, y, heading), not {list(plans.shape[1:])}"
        )
    for number in np.flatnonzero(~np.isfinite(plans).all(axis=(1, 2)))[:1]:
        raise ScoreError(f"plans/{number}", "holds values that are not finite")
    if np.abs(plans).max(initial=0) > 1e4:
        raise ScoreError("plans", "hold values beyond ±10000")
    every = _PLANS[plans.shape[1]]
    given = np.empty((len(plans), plans.shape[1] + 1, 3))
    given[:, 0], given[:, 1:] = ego[: HEADING + 1], plans
    if centre:
        given[:, 1:, 0] -= vehicle.centre_m * np.cos(plans[..., 2])
        given[:, 1:, 1] -= vehicle.centre_m * np.sin(plans[..., 2])
    given[..., 2] = np.unwrap(given[..., 2], axis=1)
    at = np.arange(STEPS + 1) * STEP_S / every
    before = np.minimum((at + 1e-9).astype(int), plans.shape[1] - 1)
    share = (at - before)[:, None]
    poses: Array = given[:, before] + share * (given[:, before + 1] - given[:, before])
    poses[..., 2] = _principal(poses[..., 2])
    return poses


def simulate(references: Array, vehicle: EgoVehicle, ego: Array) -> Array:
    """Drive along ``references`` [n, 41, 3] from the state ``ego`` [11]; states [n, 41, 11]."""
    speeds, curvatures = profiles(references)
    # Plans lie on the last axis, so that each step works on whole blocks of memory.
    poses = np.ascontiguousarray(references.transpose(1, 2, 0))
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    last = speeds.shape[1] - 1
    speeds = np.ascontiguousarray(speeds.T)
    curvature_ahead = np.concatenate([curvatures.T, np.repeat(curvatures.T[-1:], HORIZON, axis=0)])
    states = np.zeros((STEPS + 1, STATE_SIZE, len(references)))
    states[0] = ego[:, None]
    # What a step's way is multiplied by: to add up the way, the turn it asks for, and the turn that a
    # command of 1 rad/s brings about.
    factors = np.empty((3, HORIZON, len(references)))
    factors[0] = 1.0
    factors[2] = _UNTIL_S / vehicle.wheelbase_m
    for step in range(STEPS):
        factors[1] = curvature_ahead[step : step + HORIZON]
        reference = (*poses[step], cos[step], sin[step])
        wanted = speeds[min(step + HORIZON, last)]
        acceleration, steering_rate = _commands(states[step], reference, wanted, factors, vehicle)
        _advance(states[step], acceleration, steering_rate, vehicle, states[step + 1])
    return np.ascontiguousarray(states.transpose(2, 0, 1))


def _commands(
    now: Array, reference: tuple[Array, ...], wanted: Array, factors: Array, vehicle: EgoVehicle
) -> tuple[Array, Array]:
    """Acceleration in m/s² and steering rate in rad/s, [n] each, in the states ``now`` [11, n]."""
    x, y, heading, cos, sin = reference
    speed, steering = now[SPEED], now[STEERING] / vehicle.wheelbase_m
    acceleration = _SPEED_GAIN * (speed - wanted)
    offset = (now[Y] - y) * cos - (now[X] - x) * sin
    turned = wrapped(now[HEADING] - heading)

    # The errors at the horizon, without a command and for a command of 1 rad/s.
    ahead = (speed + acceleration * _UNTIL_S) * STEP_S
    until = (ahead * factors).cumsum(axis=1)
    way, bend, by_turn = until[:, -1]
    aside, bent, by_offset = (ahead[1:] * until[:, :-1]).sum(axis=1)
    free_offset = offset + way * turned + steering * aside - bent
    free_turn = wrapped(turned + steering * way - bend)

    pull = OFFSET_WEIGHT * by_offset * free_offset + HEADING_WEIGHT * by_turn * free_turn
    steering_rate = -pull / (OFFSET_WEIGHT * by_offset * by_offset + HEADING_WEIGHT * by_turn * by_turn + 1.0)
    stopping = (wanted <= STOPPING_MPS) & (speed <= STOPPING_MPS)
    if stopping.any():
        acceleration = np.where(stopping, -STOPPING_GAIN * (speed - wanted), acceleration)
        steering_rate = np.where(stopping, 0.0, steering_rate)
    return acceleration, steering_rate


def _advance(
    now: Array, acceleration: Array, steering_rate: Array, vehicle: EgoVehicle, after: Array
) -> None:
    """Write into ``after`` [11, n] where the car is one step later; both commands come with a lag."""
    steering, speed, heading = now[STEERING], now[SPEED], now[HEADING]
    gained = _ACCELERATION_SHARE * (acceleration - now[ACCELERATION]) + now[ACCELERATION]
    rate = _STEERING_SHARE * steering_rate
    way = speed * STEP_S
    after[X] = now[X] + way * np.cos(heading)
    after[Y] = now[Y] + way * np.sin(heading)
    after[HEADING] = _principal(heading + way * np.tan(steering) / vehicle.wheelbase_m)
    after[SPEED] = speed + gained * STEP_S
    turned = steering + rate * STEP_S
    after[STEERING] = np.minimum(np.maximum(turned, -MAX_STEERING_RAD), MAX_STEERING_RAD)
    after[YAW_RATE] = after[SPEED] * np.tan(after[STEERING]) / vehicle.wheelbase_m
    after[ACCELERATION] = gained
    after[YAW_ACCELERATION] = (after[YAW_RATE] - now[YAW_RATE]) / STEP_S
    after[STEERING_RATE] = rate


def _principal(angle: Array) -> Array:
    """Angles brought to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
