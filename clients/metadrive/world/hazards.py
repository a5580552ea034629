"""What makes an episode difficult: placed ahead on the route, or set off while the expert passes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from looktwice.clients.metadrive.world.actors import Body, Pedestrian, StillBody, Vehicle
from looktwice.clients.metadrive.world.car_following import look
from looktwice.clients.metadrive.world.roads import Rail, RoadMap


@dataclass(frozen=True)
class HazardMix:
    """What waits along a route, and how often.

    Attributes:
        shares: of each kind; they add up to 1.
        spacing_m: least and most metres from one to the next.
        first_m: to the first one, on average.
    """

    shares: Mapping[str, float]
    spacing_m: tuple[float, float]
    first_m: float


USUAL: Final = HazardMix(
    {"breakdown": 0.22, "closure": 0.26, "queue": 0.16, "pedestrian": 0.36}, (130.0, 290.0), 90.0
)
MANY: Final = HazardMix(
    {"breakdown": 0.38, "closure": 0.14, "queue": 0.14, "pedestrian": 0.34}, (55.0, 120.0), 60.0
)
"""Above all what models misread: cars that have broken down, and people."""
_LAST_M: Final = 90.0
_CUT_IN_INDICATES_S: Final = 1.0
_FAIR_BRAKE: Final = 2.2
"""Nobody cuts in where the expert would have to brake harder at once."""
_CALM_S: Final = 12.0
"""How long a leader that braked is left alone."""


class Director:
    """Places hazards along the route and sets off what leaders and neighbours do."""

    def __init__(
        self,
        road_map: RoadMap,
        rng: np.random.Generator,
        new_id: Callable[[], int],
        limit: float,
        hazards: HazardMix = USUAL,
    ) -> None:
        self._map, self._hazards = road_map, hazards
        self._rng = rng
        self._new_id = new_id
        self._speed = limit
        self._next_event_s = float(rng.uniform(2.5, 7.0))
        self._queues: list[tuple[float, list[Vehicle], float]] = []
        self._released: dict[int, float] = {}
        self._cutting: list[tuple[Vehicle, int, float]] = []

    def place(self, start: float) -> list[Body]:
        """Everything that waits along the route from progress ``start``."""
        bodies: list[Body] = []
        names, shares = list(self._hazards.shares), list(self._hazards.shares.values())
        at = start + self._hazards.first_m * float(self._rng.uniform(0.6, 1.4))
        while at < self._map.length - _LAST_M:
            index = self._map.route_index(at)
            begin = self._map.road_starts[index]
            road = self._map.roads[self._map.route[index]]
            room = begin + 20 < at < begin + self._map.road_length(road.road_id) - 35
            if road.turn is not None or not room:
                at += 12.0
                continue
            kind = str(self._rng.choice(names, p=shares))
            if kind == "breakdown":
                bodies += self._breakdown(at)
            elif kind == "closure":
                bodies += self._closure(at)
            elif kind == "queue":
                bodies += self._queue(at)
            else:
                bodies += self._pedestrians(at)
            at += float(self._rng.uniform(*self._hazards.spacing_m))
        return bodies

    def _rails_at(self, progress: float) -> list[int]:
        """The rails at ``progress`` from left to right."""
        index = self._map.route_index(progress)
        found = [self._map.rail_of_lane(lane) for lane in self._map.roads[self._map.route[index]].lanes]
        return [rail for rail in found if rail is not None]

    def standing(self, rail: int, progress: float, offset: float = 0.0) -> Vehicle:
        """A vehicle of random model that stands on ``rail``."""
        rails = self._map.rails
        model = str(self._rng.choice(["beetle", "130"]))
        car = Vehicle(self._new_id(), "vehicle", model, 0, 0, 0, 0, progress)
        car.rail, car.s, car.wander_m, car.tint = (
            rail,
            rails[rail].s_at(progress),
            0.0,
            float(self._rng.random()),
        )
        car.place(rails)
        if offset:
            car.x, car.y, car.heading = rails[rail].pose(car.s, offset)
        return car

    def _breakdown(self, at: float) -> list[Body]:
        options = self._rails_at(at)
        if len(options) < 2:
            return []
        car = self.standing(int(self._rng.choice(options)), at, float(self._rng.uniform(-0.3, 0.3)))
        car.hold, car.hazard_lights = True, True
        return [car]

    def _closure(self, at: float) -> list[Body]:
        options = self._rails_at(at)
        if len(options) < 2:
            return []
        closed = options[0] if self._rng.random() < 0.45 else options[-1]
        outer = 1.0 if closed == options[0] else -1.0
        rail = self._map.rails[closed]
        s = rail.s_at(at)
        length = float(self._rng.uniform(12, 28))
        bodies: list[Body] = []
        for k, offset in enumerate((1.2, 0.4, -0.4, -1.2)):
            bodies.append(self._obstacle("cone", rail, s + 2.2 * k, outer * offset))
        for extra in np.arange(8.0, 8.0 + length, 5.0):
            bodies.append(self._obstacle("cone", rail, s + float(extra), -outer * 1.3))
        for offset in (0.75, -0.95):
            bodies.append(self._obstacle("barrier", rail, s + 12.0, outer * offset))
        return bodies

    def _obstacle(self, kind: str, rail: Rail, s: float, offset: float) -> StillBody:
        x, y, heading = rail.pose(s, offset)
        kind_name = "cone" if kind == "cone" else "barrier"
        return StillBody(self._new_id(), kind_name, kind, x, y, heading, 0.0, rail.progress(s))  # type: ignore[arg-type]

    def _queue(self, at: float) -> list[Body]:
        cars: list[Vehicle] = []
        for rail in self._rails_at(at):
            position = at + float(self._rng.uniform(-3, 3))
            for _ in range(int(self._rng.integers(1, 5))):
                if self._map.rails[rail].covers(position, 5.0):
                    car = self.standing(rail, position, float(self._rng.uniform(-0.2, 0.2)))
                    car.hold = True
                    cars.append(car)
                position -= float(self._rng.uniform(6.5, 8.5))
        self._queues.append((at, cars, float(self._rng.uniform(3.0, 10.0))))
        return list(cars)

    def _pedestrians(self, at: float) -> list[Body]:
        options = self._rails_at(at)
        if not options:
            return []
        rail = self._map.rails[options[-1]]
        s = rail.s_at(at)
        index = self._map.route_index(at)
        width = self._map.lanes[rail.lane_at(s)].width
        right_edge = -0.5 * width
        left_edge = (len(options) - 0.5) * width
        oncoming = (
            len(self._map.roads[self._map.route[index]].lanes) * width if self._map.oncoming_rails else 0.0
        )
        people: list[Body] = []
        crosses = bool(self._rng.random() < 0.7)
        for k in range(int(self._rng.choice([1, 1, 2]))):
            here = s + 1.3 * k + float(self._rng.uniform(-0.4, 0.4))
            from_right = bool(self._rng.random() < 0.65)
            reach = left_edge + oncoming - right_edge + 2.6
            offset = right_edge - 1.3 if from_right else right_edge + reach - 1.3
            x, y, heading = rail.pose(here, offset)
            walk = heading + (math.pi / 2 if from_right else -math.pi / 2)
            person = Pedestrian(
                self._new_id(), "pedestrian", "pedestrian", x, y, walk, 0.0, rail.progress(here)
            )
            person.walking_speed = float(self._rng.uniform(1.1, 2.0))
            person.walk_m, person.crosses = reach, crosses
            person.eagerness_s = float(self._rng.uniform(-1.0, 2.5))
            person.tint = float(self._rng.random())
            people.append(person)
        return people

    def step(self, time_s: float, ego: Vehicle, bodies: list[Body]) -> None:
        """Set off what is due."""
        self._release_queues(time_s, ego)
        for body in bodies:
            if isinstance(body, Pedestrian) and body.crosses and not body.walking:
                self._maybe_walk(body, ego)
        self._finish_cut_ins(time_s, ego)
        if time_s < self._next_event_s or ego.speed < 0.45 * self._speed:
            return
        self._next_event_s = time_s + float(self._rng.uniform(4.0, 8.0))
        if self._start_cut_in(time_s, ego, bodies) or self._rng.random() < 0.35:
            return
        self._brake_leader(time_s, ego, bodies)

    def _release_queues(self, time_s: float, ego: Vehicle) -> None:
        for number, (at, cars, wait_s) in enumerate(self._queues):
            if number in self._released:
                for place, car in enumerate(sorted(cars, key=lambda c: -c.progress)):
                    if car.hold and time_s > self._released[number] + 0.9 * (place // 2):
                        car.hold = False
            elif 0 < at - ego.progress < 70 and (ego.speed < 4.0 or at - ego.progress < 25):
                self._released[number] = time_s + wait_s

    def _maybe_walk(self, person: Pedestrian, ego: Vehicle) -> None:
        distance = person.progress - ego.progress
        if not 6.0 < distance < 90.0:
            return
        across = math.hypot(person.x - ego.x, person.y - ego.y)
        lateral = math.sqrt(max(across**2 - distance**2, 0.0))
        reaches_in = max(lateral - 2.0, 0.0) / person.walking_speed
        stops_in = ego.speed**2 / (2 * 2.8) + 9.0
        if distance > stops_in and distance / max(ego.speed, 2.0) < reaches_in + 1.5 + person.eagerness_s:
            person.walking = True

    def _brake_leader(self, time_s: float, ego: Vehicle, bodies: list[Body]) -> None:
        view = look(ego, self._map.rails[ego.rail], bodies)
        ahead = (view.s > ego.s + 4) & (view.s < ego.s + 55) & (np.abs(view.offset) < 1.2)
        for i in np.argsort(view.s):
            lead = view.bodies[i]
            if not ahead[i] or not isinstance(lead, Vehicle) or lead.speed < 4.0:
                continue
            if time_s < lead.brake_until_s + _CALM_S:
                return
            gap = view.s[i] - ego.s - 5
            lead.brake_rate = float(self._rng.uniform(1.5, 4.5))
            if gap < 0.6 * ego.speed:
                lead.brake_rate = min(lead.brake_rate, 2.5)
            lead.brake_to = (
                0.0 if self._rng.random() < 0.4 else float(self._rng.uniform(0.25, 0.65)) * lead.speed
            )
            lead.brake_until_s = time_s + lead.speed / lead.brake_rate + float(self._rng.uniform(0.8, 4.0))
            if lead.brake_to == 0.0 and self._rng.random() < 0.45 and self._may_break_down(lead.progress):
                lead.brake_until_s = 1e9  # breaks down: blinks once it stands
            return

    def _may_break_down(self, progress: float) -> bool:
        index = self._map.route_index(progress)
        road = self._map.roads[self._map.route[index]]
        left = self._map.road_starts[index] + self._map.road_length(road.road_id) - progress
        return road.turn is None and left > 60 and len(self._rails_at(progress)) > 1

    def _start_cut_in(self, time_s: float, ego: Vehicle, bodies: list[Body]) -> bool:
        view = look(ego, self._map.rails[ego.rail], bodies)
        gap = view.s - ego.s
        for i in np.argsort(gap):
            car = view.bodies[i]
            beside = 2.2 < abs(view.offset[i]) < 4.6 and 8 + 0.35 * ego.speed < gap[i] < 26 + 0.6 * ego.speed
            if (
                not beside
                or not isinstance(car, Vehicle)
                or car.shift is not None
                or car.hold
                or car.speed < 3
            ):
                continue
            if self._map.roads[self._map.route[self._map.route_index(car.progress)]].turn is not None:
                continue
            side = 1 if view.offset[i] < 0 else -1
            if self._map.neighbour(car.rail, car.progress, side) != ego.rail:
                continue
            others = (np.abs(view.offset) < 1.6) & (np.abs(view.s - view.s[i]) < 9)
            if others.any() or view.along[i] < ego.speed - 5:
                continue
            car.indicator = side
            self._cutting.append((car, ego.rail, time_s + _CUT_IN_INDICATES_S))
            return True
        return False

    def _finish_cut_ins(self, time_s: float, ego: Vehicle) -> None:
        for entry in list(self._cutting):
            car, rail, due = entry
            if time_s < due:
                continue
            self._cutting.remove(entry)
            gap = car.progress - ego.progress
            on_junction = (
                self._map.roads[self._map.route[self._map.route_index(car.progress)]].turn is not None
            )
            closing = max(ego.speed - car.speed, 0.0)
            fair = gap > 7.5 + 0.3 * ego.speed and closing**2 < 2 * _FAIR_BRAKE * max(
                gap - 8.0 - 0.5 * closing, 0.1
            )
            braking = car.brake_until_s > time_s
            free = ego.rail == rail and ego.shift is None and car.shift is None
            if fair and free and car.speed > 2 and not on_junction and not braking:
                car.change_to(self._map.rails, rail, max(2.8 * car.speed, 14.0))
            else:
                car.indicator = 0
