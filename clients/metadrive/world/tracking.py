"""A car that follows a planned trajectory: a kinematic bicycle with a driver's limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from looktwice.clients.metadrive.world.actors import STEP_S, Vehicle
from looktwice.clients.metadrive.world.roads import Array, RoadMap
from looktwice.model.driving.driven_car import (
    ACCELERATION,
    CATCH_UP,
    JERK,
    LOOK_AHEAD_M,
    LOOK_AHEAD_S,
    MAX_STEER_RAD,
    SPEED_AHEAD_S,
    STEER_RATE,
    WHEELBASE_M,
)
from looktwice.model.driving.trajectory import FloatArray


@dataclass
class FreeVehicle(Vehicle):
    """A vehicle that moves as it is steered; rail, arc length and progress follow from where it is."""

    steer: float = 0.0
    offset_m: float = 0.0

    @classmethod
    def from_rails(cls, car: Vehicle) -> FreeVehicle:
        """Take over where a vehicle on rails is now."""
        free = cls(car.actor_id, car.kind, car.model, car.x, car.y, car.heading, car.speed, car.progress)
        free.rail, free.s, free.acceleration = car.rail, car.s, car.acceleration
        return free

    def offset_at(self, s: float) -> tuple[float, float]:
        """Where it is beside its rail; it has no plan that others could know."""
        return self.offset_m, 0.0

    def follow(self, trajectory: Array, age_s: float, road_map: RoadMap) -> None:
        """Move one step along a trajectory.

        Speed: what brings it to the trajectory's speed soon. Steering: pure pursuit of a point ahead.

        Args:
            trajectory: world poses [k, 4] (x, y, heading, speed) at 10 Hz, the first at age 0.
            age_s: how long ago the trajectory began.
            road_map: to find rail and progress by.
        """
        ahead = _at(trajectory, age_s + SPEED_AHEAD_S)
        wanted = (ahead[3] - self.speed) / SPEED_AHEAD_S
        # Ground lost or gained against the plan is made up for as well.
        due = _at(trajectory, age_s)
        behind = (due[0] - self.x) * math.cos(self.heading) + (due[1] - self.y) * math.sin(self.heading)
        wanted += CATCH_UP * behind
        change = min(max(wanted - self.acceleration, -JERK * STEP_S), JERK * STEP_S)
        acceleration = min(max(self.acceleration + change, ACCELERATION[0]), ACCELERATION[1])
        self._move(acceleration, self._pursue(trajectory, age_s))
        self._locate(road_map)

    def _pursue(self, trajectory: Array, age_s: float) -> float:
        """The steering angle whose arc meets the trajectory some way ahead."""
        reach = LOOK_AHEAD_M + LOOK_AHEAD_S * abs(self.speed)
        rest = trajectory[int(age_s / STEP_S) :]
        apart = np.hypot(rest[:, 0] - self.x, rest[:, 1] - self.y)
        far = np.flatnonzero(apart >= reach)
        if not len(far):
            return self.steer  # it ends within reach: the car stands, or nearly so
        x, y = rest[far[0], 0] - self.x, rest[far[0], 1] - self.y
        left = -x * math.sin(self.heading) + y * math.cos(self.heading)
        return math.atan2(2.0 * WHEELBASE_M * left, apart[far[0]] ** 2)

    def _move(self, acceleration: float, steer: float) -> None:
        steer = min(max(steer, -MAX_STEER_RAD), MAX_STEER_RAD)
        change = min(max(steer - self.steer, -STEER_RATE * STEP_S), STEER_RATE * STEP_S)
        self.steer += change
        speed = self.speed + acceleration * STEP_S
        if self.speed >= 0 and speed < 0:
            speed = 0.0
        mean = 0.5 * (self.speed + speed)
        turned = mean * math.tan(self.steer) / WHEELBASE_M * STEP_S
        self.x += mean * STEP_S * math.cos(self.heading + 0.5 * turned)
        self.y += mean * STEP_S * math.sin(self.heading + 0.5 * turned)
        self.heading += turned
        self.acceleration = (speed - self.speed) / STEP_S
        self.speed = speed
        self.stopped_for_s = self.stopped_for_s + STEP_S if abs(speed) < 0.1 else 0.0

    def _locate(self, road_map: RoadMap) -> None:
        """The nearest rail at this progress, and the place along it."""
        here = np.array([[self.x, self.y]])
        best: tuple[float, int, float] | None = None
        for number, rail in enumerate(road_map.rails):
            if not rail.covers(self.progress, -5.0):
                continue
            s, offset = rail.project(here, np.array([rail.s_at(self.progress)]))
            if best is None or abs(offset[0]) < abs(best[0]):
                best = (float(offset[0]), number, float(s[0]))
        if best is not None:
            self.offset_m, self.rail, self.s = best
            self.progress = road_map.rails[self.rail].progress(self.s)


def world_trajectory(ego: Array, trajectory: FloatArray) -> Array:
    """A planned trajectory as the world sees it.

    Args:
        ego: x, y, heading, speed when it was planned.
        trajectory: [64, 4] in the ego frame: x, y, z, heading.

    Returns:
        [65, 4]: x, y, heading, speed at 10 Hz, the first of them ``ego``.
    """
    cos, sin = math.cos(ego[2]), math.sin(ego[2])
    world = np.empty((len(trajectory) + 1, 4))
    world[0] = ego
    world[1:, 0] = ego[0] + cos * trajectory[:, 0] - sin * trajectory[:, 1]
    world[1:, 1] = ego[1] + sin * trajectory[:, 0] + cos * trajectory[:, 1]
    world[1:, 2] = ego[2] + trajectory[:, 3]
    steps = np.diff(world[:, :2], axis=0)
    along = steps[:, 0] * np.cos(world[1:, 2]) + steps[:, 1] * np.sin(world[1:, 2])
    world[1:, 3] = along / STEP_S
    return world


def _at(trajectory: Array, age_s: float) -> Array:
    """The pose at an age, between rows; the last one goes on for ever."""
    place = min(age_s / STEP_S, len(trajectory) - 1.0)
    row = min(int(place), len(trajectory) - 2)
    share = place - row
    found: Array = (1 - share) * trajectory[row] + share * trajectory[row + 1]
    return found
