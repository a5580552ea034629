"""What would happen if: a world copied at any moment, and driven on by the expert or along a trajectory.

A fork is a whole world of its own on the same map: others in it react to what the ego does there. On rails,
the expert's fork is its real future to the last bit. Where a planner has been driving, the expert takes
over from where the car is, however it stands, and comes back to its lane on a smooth curve.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from looktwice.clients.metadrive.world.actors import STEP_S, Body, Drift, Pedestrian, StillBody, Vehicle
from looktwice.clients.metadrive.world.episode import EpisodeWorld
from looktwice.clients.metadrive.world.episode_log import EpisodeLog
from looktwice.clients.metadrive.world.roads import Array, RoadMap
from looktwice.clients.metadrive.world.tracking import FreeVehicle, world_trajectory
from looktwice.model.driving.outcome import OFF_ROUTE_M, HitKind
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray, to_ego_frame

_RETURN_S: Final = 2.2
_SHORTEST_RETURN_M: Final = 12.0
_STEEPEST_RAD: Final = 0.8
"""A car that stands more askew than this is first turned so far: rails cannot be left at right angles."""


class ForkError(ValueError):
    """A world that cannot be forked; the text says why."""


@dataclass(frozen=True, eq=False)
class Forked:
    """What happened in a fork.

    Attributes:
        trajectory: float32 [k, 4] poses at 10 Hz in the ego frame of the fork's moment, the first at +0.1 s;
            k is 64 unless a collision ended it before.
        speeds_ms: float32 [k], signed.
        driven_m: along the route.
        collided_s: when it collided, seconds from the fork; None where it did not.
        hit: what it collided with, or None.
        off_road_s: when it first left the road, or None.
        off_route_s: when it first left all lanes of its route (`OFF_ROUTE_M`), or None; on rails none does.
        log: the whole episode, of which the fork is the end.
    """

    trajectory: FloatArray
    speeds_ms: FloatArray
    driven_m: float
    collided_s: float | None
    hit: HitKind | None
    off_road_s: float | None
    off_route_s: float | None
    log: EpisodeLog

    @property
    def is_safe(self) -> bool:
        """Whether it neither collided nor left the road."""
        return self.collided_s is None and self.off_road_s is None


def fork_expert(
    world: EpisodeWorld,
    steps: int = FUTURE_STEPS,
    *,
    times_speed: float = 1.0,
    known: Container[int] | None = None,
) -> Forked:
    """Let the expert drive on from now in a copy of ``world``.

    Args:
        world: to copy.
        steps: to drive.
        times_speed: what the ego's speed is multiplied by at first. Its past stays in the log as it was.
        known: ids of those whom the expert knows of; it drives as if nobody else were there. None: of all.

    Raises:
        ForkError: the episode has ended.
    """
    forked = _copied(world, steps)
    forked.ego.speed *= times_speed
    if isinstance(forked.ego, FreeVehicle):
        forked.ego = on_rails(forked.ego, forked.live.road_map)

    def drive(_: float, bodies: list[Body]) -> None:
        known_of = bodies if known is None else [body for body in bodies if body.actor_id in known]
        forked.drive_as_expert(known_of)

    return _run(forked, steps, drive)


def fork_along(world: EpisodeWorld, trajectory: FloatArray, steps: int = FUTURE_STEPS) -> Forked:
    """Follow a trajectory [64, 4] of the ego frame of now in a copy of ``world``, as a driven car would.

    Raises:
        ForkError: the episode has ended.
    """
    forked = _copied(world, steps)
    ego = forked.ego
    if not isinstance(ego, FreeVehicle):
        ego = forked.ego = FreeVehicle.from_rails(ego)
    way = world_trajectory(forked.live.ego[forked.now], trajectory)
    return _run(forked, steps, lambda age_s, _: ego.follow(way, age_s, forked.live.road_map))


def on_rails(car: Vehicle, road_map: RoadMap) -> Vehicle:
    """A vehicle on rails where a free one is, on its way back to the middle of its lane."""
    rail = road_map.rails[car.rail]
    along, left = rail.project(np.array([[car.x, car.y]]), np.array([car.s]))
    s, offset = float(along[0]), float(left[0])
    index = int(np.clip(s * 2, 0, len(rail.heading) - 1))
    askew = math.remainder(car.heading - float(rail.heading[index]), 2 * math.pi)
    slope = math.tan(min(max(askew, -_STEEPEST_RAD), _STEEPEST_RAD))
    vehicle = Vehicle(
        car.actor_id, car.kind, car.model, car.x, car.y, car.heading, max(car.speed, 0.0), car.progress
    )
    vehicle.rail, vehicle.s = car.rail, s
    vehicle.acceleration, vehicle.stopped_for_s = car.acceleration, car.stopped_for_s
    back = max(_SHORTEST_RETURN_M, _RETURN_S * abs(car.speed))
    vehicle.drift = Return(s, offset, 0.0, back, slope * (1 - offset * float(rail.curvature[index])))
    return vehicle


@dataclass
class Return(Drift):
    """The way back to a rail from beside it: a cubic that begins with the car's own slope and ends flat."""

    slope: float = 0.0

    def at(self, s: float) -> tuple[float, float]:
        """See `Drift.at`."""
        u = min(max((s - self.start_s) / self.back, 0.0), 1.0)
        from_offset, from_slope = 2 * u**3 - 3 * u * u + 1, u**3 - 2 * u * u + u
        offset = self.offset * from_offset + self.slope * self.back * from_slope
        rate = self.offset * (6 * u * u - 6 * u) / self.back + self.slope * (3 * u * u - 4 * u + 1)
        return offset, rate


def _copied(world: EpisodeWorld, steps: int) -> EpisodeWorld:
    if world.ended:
        raise ForkError(f"episode {world.live.seed} has ended ({world.outcome}): nothing goes on from here")
    return world.copied(steps)


def _run(world: EpisodeWorld, steps: int, drive: Callable[[float, list[Body]], None]) -> Forked:
    """What happens while ``drive`` moves the ego, told how many seconds have passed and who is near."""
    start, began_m = world.now, world.ego.progress
    near = world.nearby()
    off_road_s: float | None = None
    off_route_s: float | None = None
    for step in range(steps):
        world.move(near, partial(drive, step * STEP_S))
        near = world.remember()
        if off_road_s is None and world.is_off_road:
            off_road_s = (step + 1) * STEP_S
        if off_route_s is None and _is_off_route(world.ego):
            off_route_s = (step + 1) * STEP_S
        if world.outcome == "collision":
            break
    driven = world.live.ego[start : world.now + 1]
    return Forked(
        _seen_from(driven),
        driven[1:, 3].astype(np.float32),
        world.ego.progress - began_m,
        None if world.hit is None else (world.now - start) * STEP_S,
        None if world.hit is None else kind_of(world.hit),
        off_road_s,
        off_route_s,
        world.log(),
    )


def _is_off_route(ego: Vehicle) -> bool:
    return isinstance(ego, FreeVehicle) and abs(ego.offset_m) > OFF_ROUTE_M


def _seen_from(ego: Array) -> FloatArray:
    poses = np.zeros((len(ego), 4))
    poses[:, :2], poses[:, 3] = ego[:, :2], ego[:, 2]
    seen = to_ego_frame(poses, poses[0])
    seen[:, 3] = np.unwrap(seen[:, 3])
    seen[:, 3] -= seen[0, 3]
    return seen[1:].astype(np.float32)


def kind_of(body: Body) -> HitKind:
    """What it is that was hit."""
    if isinstance(body, Pedestrian):
        return "pedestrian"
    if isinstance(body, StillBody):
        return "obstacle"
    if isinstance(body, Vehicle) and not body.on_route:
        return "oncoming vehicle"
    return "standing vehicle" if abs(body.speed) < 0.5 else "moving vehicle"
