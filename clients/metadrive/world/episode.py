"""One episode: the ego among traffic and hazards, step by step, without pictures."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from typing import Final

import numpy as np
import shapely

from looktwice.clients.metadrive.world.actors import STEP_S, VEHICLE_MODELS, Body, Pedestrian, Vehicle
from looktwice.clients.metadrive.world.car_following import SpeedLimits, Style
from looktwice.clients.metadrive.world.drifts import Drifter
from looktwice.clients.metadrive.world.episode_log import EpisodeLog, Outcome, Recorder
from looktwice.clients.metadrive.world.expert import Expert, varied
from looktwice.clients.metadrive.world.hazards import USUAL, Director, HazardMix
from looktwice.clients.metadrive.world.late_braking import LateBraking
from looktwice.clients.metadrive.world.maps import make_map
from looktwice.clients.metadrive.world.roads import Array, RoadMap
from looktwice.clients.metadrive.world.tracking import FreeVehicle
from looktwice.model.driving.metrics import box_corners
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M

_AHEAD_M: Final = 170.0
_BEHIND_M: Final = 80.0


def run_episode(
    seed: int, duration_s: float = 48.0, *, drifts: bool = False, lapses: bool = False
) -> EpisodeLog:
    """Let the expert drive one episode; the same seed gives the same episode.

    Args:
        seed: of the episode.
        duration_s: at most.
        drifts: whether the expert strays from its line now and then, and comes back.
        lapses: whether it brakes late now and then.

    Raises:
        MapError: no map fits the seed.
    """
    *_, world = worlds_of_episode(seed, duration_s, drifts=drifts, lapses=lapses)
    return world.log()


def worlds_of_episode(
    seed: int, duration_s: float = 48.0, *, drifts: bool = False, lapses: bool = False
) -> Iterator[EpisodeWorld]:
    """The episode of `run_episode` as it goes on: one and the same world at every step of 0.1 s.

    It may be forked or copied at any of them, and must not be moved by anybody else.

    Raises:
        MapError: no map fits the seed.
    """
    world = make_world(seed, duration_s, LateBraking(seed) if lapses else None)
    drifter = Drifter(seed) if drifts else None
    near = world.remember()
    yield world
    while not world.ended:
        if drifter is not None:
            drifter.step(world.now * STEP_S, world.ego)
        world.move(near, world.drive_as_expert)
        near = world.remember()
        yield world


def make_world(
    seed: int, duration_s: float = 48.0, lapses: LateBraking | None = None, hazards: HazardMix = USUAL
) -> EpisodeWorld:
    """An episode before its first step, its expert's ``lapses`` given; raises `MapError`."""
    rng = np.random.default_rng([seed, 2])
    speed = float(
        rng.choice([rng.uniform(22, 42), rng.uniform(42, 62), rng.uniform(62, 80)], p=[0.04, 0.14, 0.82])
    )
    style = varied(Style(speed / 3.6), rng)
    road_map = make_map(seed, max(320.0, 1.15 * duration_s * style.speed))
    return EpisodeWorld(seed, road_map, style, rng, round(duration_s / STEP_S), lapses, hazards)


class EpisodeWorld:
    """Everything that moves in an episode, and what is remembered of it.

    Args:
        seed: of the episode.
        road_map: where it takes place.
        style: how the expert drives.
        rng: decides about everything else.
        steps: of 0.1 s, at most.
        lapses: of the expert.
        hazards: that wait along the route.

    Attributes:
        ego: the vehicle whose episode it is; whoever drives it may put another one in its place.
        outcome: how it ended; ``time`` while it runs.
        ended: whether it did.
        hit: whom the ego collided with, if it did.
    """

    def __init__(
        self,
        seed: int,
        road_map: RoadMap,
        style: Style,
        rng: np.random.Generator,
        steps: int,
        lapses: LateBraking | None = None,
        hazards: HazardMix = USUAL,
    ) -> None:
        self._map = road_map
        self._rng = rng
        self._steps = steps
        self.outcome: Outcome = "time"
        self.ended = False
        self.hit: Body | None = None
        self._ids = count(1)
        self._limits = SpeedLimits(road_map.rails, style.lateral)
        self._oncoming_limits = SpeedLimits(road_map.oncoming_rails, 2.0)
        self.ego = self._new_ego(style)
        self._style = style
        self._expert = Expert(road_map, style, self._limits, True, bool(rng.random() < 0.75), lapses)
        self._director = Director(road_map, rng, self._next_id, style.speed, hazards)
        self._bodies: list[Body] = self._director.place(self.ego.progress)
        self._fill_oncoming_s()
        self._drivers: dict[int, Expert] = {}
        self._bodies += self._traffic()
        for body in self._bodies:
            if isinstance(body, Vehicle) and body.actor_id not in self._drivers:
                self._drivers[body.actor_id] = self._driver(body, float(rng.uniform(0.75, 1.0)) * style.speed)
        self._recorder = Recorder(seed, road_map, self._bodies, steps)

    def _next_id(self) -> int:
        return next(self._ids)

    def _new_ego(self, style: Style) -> Vehicle:
        rng, rails = self._rng, self._map.rails
        first = [i for i, rail in enumerate(rails) if rail.breaks_progress[0] < 1.0]
        rail = int(rng.choice(first))
        ego = Vehicle(0, "vehicle", "130", 0, 0, 0, 0, 0)
        ego.rail, ego.s = rail, 30.0
        ego.wander_m, ego.rng_phase = float(rng.uniform(0.02, 0.12)), float(rng.uniform(0, 6))
        ego.place(rails)
        if rng.random() > 0.24:
            ego.speed = min(style.speed * float(rng.uniform(0.5, 0.95)), self._limits.at(rail, ego.s))
        return ego

    def _driver(self, car: Vehicle, speed: float) -> Expert:
        limits = self._limits if car.on_route else self._oncoming_limits
        return Expert(self._map, replace(varied(Style(speed), self._rng), lateral=2.0), limits, False, False)

    def _fill_oncoming_s(self) -> None:
        if not self._map.oncoming_rails:
            return
        rail = self._map.oncoming_rails[0]
        for body in self._bodies:
            gap = np.hypot(rail.points[:, 0] - body.x, rail.points[:, 1] - body.y)
            body.oncoming_s = 0.5 * float(np.argmin(gap)) if gap.min() < 25 else -1e6

    def _traffic(self) -> Iterator[Vehicle]:
        rng, ego = self._rng, self.ego
        density = float(rng.choice([2.0, 3.4, 6.0]))
        taken = [(b.progress, b.rail) for b in self._bodies if isinstance(b, Vehicle)]
        blocked = [b.progress for b in self._bodies if not isinstance(b, (Vehicle, Pedestrian))]
        for index, rail in enumerate(self._map.rails):
            if rail.length < 120:
                continue
            s = rail.s_at(ego.progress) + float(rng.uniform(16, 55))
            if index != ego.rail:
                s += float(rng.uniform(-25, 10))
                if abs(rail.progress(s) - ego.progress) < 12:
                    s += 15
            while s < rail.length - 40:
                progress = rail.progress(s)
                clear = all(abs(progress - p) > 14 for p, r in taken if r == index)
                clear = clear and all(not -20 < p - progress < 25 for p in blocked)
                if clear:
                    yield self._moving(index, s, True, progress - ego.progress)
                s += float(rng.exponential(55 * density)) + 14
        for index, rail in enumerate(self._map.oncoming_rails):
            s = float(rng.uniform(0, 60))
            while s < rail.length - 20:
                yield self._moving(index, s, False, 1e3)
                s += float(rng.exponential(60 * density)) + 20

    def _moving(self, rail: int, s: float, on_route: bool, ahead_m: float) -> Vehicle:
        rng = self._rng
        rails = self._map.rails if on_route else self._map.oncoming_rails
        limits = self._limits if on_route else self._oncoming_limits
        car = Vehicle(self._next_id(), "vehicle", str(rng.choice(VEHICLE_MODELS)), 0, 0, 0, 0, 0)
        car.rail, car.s, car.on_route = rail, s, on_route
        car.wander_m, car.rng_phase = float(rng.uniform(0, 0.12)), float(rng.uniform(0, 6))
        car.tint = float(rng.random())
        car.place(rails)
        wish = float(rng.uniform(0.78, 1.18)) * self._style.speed
        self._drivers[car.actor_id] = self._driver(car, max(wish, 4.0))
        car.speed = min(wish, limits.at(rail, s))
        if on_route and abs(ahead_m) < 60:
            car.speed = min(car.speed, self.ego.speed + float(rng.uniform(-2, 2)))
            car.speed = 0.0 if self.ego.speed == 0 else max(car.speed, 0.0)
        return car

    @property
    def now(self) -> int:
        """The step that was remembered last."""
        return self._recorder.steps - 1

    @property
    def live(self) -> EpisodeLog:
        """The log as it grows, with room for all steps."""
        return self._recorder.live

    def log(self) -> EpisodeLog:
        """What happened so far."""
        return self._recorder.log(self.outcome)

    def remember(self) -> list[Body]:
        """Write this moment into the log, and see whether it is the last; returns who is near."""
        ego, near = self.ego, self.nearby()
        self._recorder.add(ego, *self._lane(), near)
        self.hit = self._hit(near)
        if self.hit is not None:
            self.outcome, self.ended = "collision", True
        elif ego.progress > self._map.length - 25:
            self.outcome, self.ended = "route_end", True
        else:
            self.ended = self._recorder.steps >= self._steps
        return near

    def move(self, near: list[Body], drive: Callable[[list[Body]], None]) -> None:
        """Let ``drive`` move the ego among those ``near``, and everyone else, on to the next moment."""
        time_s = self.now * STEP_S
        self._director.step(time_s, self.ego, near)
        everyone: list[Body] = [self.ego, *near]
        drive(near)
        for body in near:
            if isinstance(body, Pedestrian):
                body.step()
            elif isinstance(body, Vehicle):
                self._drive(body, time_s, everyone)

    def drive_as_expert(self, near: list[Body]) -> None:
        """Move the ego as the expert does."""
        self._expert.step(self.ego, near)

    def nearby(self) -> list[Body]:
        """Who is near the ego now."""
        ego = self.ego
        near: list[Body] = []
        for body in self._bodies:
            if isinstance(body, Vehicle):
                if body.gone:
                    continue
                if not body.on_route:
                    if math.hypot(body.x - ego.x, body.y - ego.y) < _AHEAD_M:
                        near.append(body)
                    continue
            ahead = body.progress - ego.progress
            if -_BEHIND_M < ahead < _AHEAD_M:
                near.append(body)
                if isinstance(body, Vehicle):
                    body.seen = True
            elif isinstance(body, Vehicle) and body.seen:
                body.gone = True
        return near

    def _drive(self, car: Vehicle, time_s: float, everyone: list[Body]) -> None:
        if car.hold:
            return
        if car.brake_until_s > time_s:
            rails = self._map.rails
            wanted = -car.brake_rate if car.speed > car.brake_to + 0.1 else 0.0
            change = min(max(wanted - car.acceleration, -0.9), 0.9)
            car.advance(rails, min(car.acceleration + change, 0.0) if car.speed > car.brake_to else 0.0)
            if car.brake_until_s > 1e8 and car.stopped_for_s > 1.0:
                car.hazard_lights, car.hold = True, True
            return
        self._drivers[car.actor_id].step(car, everyone)

    def _lane(self) -> tuple[int, float]:
        ego, road_map = self.ego, self._map
        rail = road_map.rails[ego.rail]
        lane = road_map.lanes[rail.lane_at(ego.s)]
        offset, _ = ego.offset_at(ego.s)
        if abs(offset) > 0.5 * lane.width:
            side = 1 if offset > 0 else -1
            beside = road_map.neighbour(ego.rail, ego.progress, side)
            if beside is not None:
                other = road_map.rails[beside]
                return other.lane_at(other.s_at(ego.progress)), offset - side * lane.width
        return lane.lane_id, offset

    def _hit(self, near: list[Body]) -> Body | None:
        ego = self.ego
        for body in near:
            if math.hypot(body.x - ego.x, body.y - ego.y) > 6.0:
                continue
            mine = box_corners(np.array([ego.x, ego.y, ego.heading]), EGO_LENGTH_M, EGO_WIDTH_M)
            theirs = box_corners(np.array([body.x, body.y, body.heading]), *body.size[:2])
            if _overlap(mine, theirs):
                return body
        return None

    @property
    def is_off_road(self) -> bool:
        """Whether a corner of the ego is beside the road now."""
        ego = self.ego
        corners = box_corners(np.array([ego.x, ego.y, ego.heading]), EGO_LENGTH_M, EGO_WIDTH_M)
        return not bool(shapely.contains_xy(self._map.drivable, corners[:, 0], corners[:, 1]).all())

    def copied(self, steps: int) -> EpisodeWorld:
        """This world once more, with ``steps`` more to go from now on; the map is shared.

        What happens in the copy does not happen here. Where somebody else has driven, its expert takes
        over: it was not there when what it would remember happened.
        """
        world = copy.deepcopy(self, {id(self._map): self._map})
        world._steps = world._recorder.steps + steps
        world._recorder.make_room(world._steps)
        if isinstance(world.ego, FreeVehicle):
            world._expert.take_over()
        return world


def _overlap(first: Array, second: Array) -> bool:
    for box in (first, second):
        for axis in (box[0] - box[1], box[1] - box[2]):
            a, b = first @ axis, second @ axis
            if a.max() < b.min() or b.max() < a.min():
                return False
    return True
