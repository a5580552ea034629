"""Random worlds for the scorer: each is a pure function of its seed, on any machine.

Only `random.Random.random` is drawn from, whose sequence Python guarantees.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

import numpy as np

from looktwice.model.driving.pdm.world import (
    ACCELERATION,
    HEADING,
    LONG_STEPS,
    PACIFICA,
    SPEED,
    STATE_SIZE,
    STEERING,
    STEPS,
    YAW_ACCELERATION,
    YAW_RATE,
    Area,
    Array,
    Lane,
    RedLight,
    TrackedBox,
    World,
)

PLANS = 5
Path = Callable[[float], tuple[float, float]]
"""From seconds to metres along and to the left of the road."""


@dataclass(frozen=True, eq=False)
class Case:
    """A world, and plans to score in it.

    Attributes:
        world: all layers are there.
        plans: [5, 8, 3] or [5, 64, 3], poses of the rear axle.
        reference, human, previous: [8, 3] each; ``previous`` was made half a second ago, from the same state.
        red_from: the step from which lights are red.
    """

    world: World
    plans: Array
    reference: Array
    human: Array
    previous: Array


class _Road:
    """A road of constant curvature, in the ego's frame."""

    def __init__(self, dice: Random, width: float) -> None:
        self.curvature = 0.0 if dice.random() < 0.4 else _between(dice, -0.02, 0.02)
        self.heading = _between(dice, -0.08, 0.08)
        self.offset = _between(dice, -0.3, 0.3) if dice.random() < 0.8 else _between(dice, -1.2, 1.2)
        self.width = width

    def at(self, along: float, left: float) -> tuple[float, float, float]:
        """World pose at a place on the road; the ego stands at along 0."""
        turned = self.curvature * along
        if abs(self.curvature) < 1e-9:
            x, y = along, 0.0
        else:
            x = math.sin(turned) / self.curvature
            y = (1 - math.cos(turned)) / self.curvature
        x, y = x - left * math.sin(turned), y + left * math.cos(turned)
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        # The middle of the ego's lane lies `offset` to the ego's left.
        return (
            cos * x - sin * y - self.offset * sin,
            sin * x + cos * y + self.offset * cos,
            self.heading + turned,
        )

    def strip(self, start: float, end: float, right: float, left: float, step: float = 5.0) -> Area:
        count = max(1, math.ceil((end - start) / step))
        alongs = [start + (end - start) * number / count for number in range(count + 1)]
        ring = [self.at(along, right)[:2] for along in alongs]
        ring += [self.at(along, left)[:2] for along in reversed(alongs)]
        return Area((np.array(ring),))


def case(seed: int) -> Case:
    """The case of ``seed``."""
    dice = Random(seed)
    road = _Road(dice, _between(dice, 3.2, 3.9))
    speed = 0.0 if dice.random() < 0.08 else _between(dice, 0.3, 14.0)
    ego = _ego(dice, speed)
    lanes, drivable, crossings, crossing = _map(dice, road)
    lights: list[RedLight] = []
    if crossing is not None and dice.random() < 0.5:
        red = np.zeros(STEPS + 1, dtype=np.bool_)
        red[: int(_between(dice, 5, 60))] = True
        closed = next(lane for lane in lanes if lane.lane_id == "over_0")
        lights.append(RedLight(closed.lane_id, closed.area, red))
    tracks = _tracks(dice, road, speed, crossing)
    line = np.array([road.at(-25 + 1.5 * number, 0.0)[:2] for number in range(90)])
    world = World(
        ego, PACIFICA, tuple(tracks), tuple(lanes), tuple(crossings), tuple(drivable), tuple(lights), line,
        _past(dice, ego),
    )  # fmt: skip
    count, every = (64, 0.1) if dice.random() < 0.15 else (8, 0.5)
    plans = np.stack([_plan(dice, road, speed, count, every) for _ in range(PLANS)])
    reference = _plan(dice, road, speed, 8, 0.5, tame=True)
    human = _plan(dice, road, speed, 8, 0.5, tame=dice.random() < 0.5)
    previous = plans[0][4::5][:8] if count == 64 else plans[0]
    previous = previous + np.array([_between(dice, -0.4, 0.4), _between(dice, -0.3, 0.3), 0.0])
    return Case(world, plans, reference, human, previous)


def _between(dice: Random, low: float, high: float) -> float:
    return low + (high - low) * dice.random()


def _ego(dice: Random, speed: float) -> Array:
    state = np.zeros(STATE_SIZE)
    state[SPEED] = speed
    state[ACCELERATION] = _between(dice, -1.5, 1.5)
    state[STEERING] = _between(dice, -0.05, 0.05)
    state[YAW_RATE] = speed * math.tan(state[STEERING]) / PACIFICA.wheelbase_m
    state[YAW_ACCELERATION] = _between(dice, -0.2, 0.2)
    return state


def _past(dice: Random, ego: Array) -> Array:
    rough = 3.0 if dice.random() < 0.15 else 0.15
    past = np.zeros((15, STATE_SIZE))
    lean = _between(dice, -0.3, 0.3)
    for row in range(15):
        ago = 0.1 * (15 - row)
        past[row, 0] = -ago * ego[SPEED]
        past[row, HEADING] = -ago * ego[YAW_RATE] + 0.002 * rough * _between(dice, -1, 1)
        past[row, SPEED] = ego[SPEED]
        past[row, ACCELERATION] = ego[ACCELERATION] + lean * ago + rough * _between(dice, -1, 1)
    return past


def _map(dice: Random, road: _Road) -> tuple[list[Lane], list[Area], list[Area], tuple[float, float] | None]:
    same = 1 + int(2.5 * dice.random())
    mine = int(same * dice.random())
    oncoming = int(2.5 * dice.random())
    start, end = -25.0, 100.0
    crossing = None
    if dice.random() < 0.45:
        begin = _between(dice, -3, 40)
        crossing = (begin, begin + _between(dice, 10, 22))
    pieces = [("all", start, end)] if crossing is None else [
        ("to", start, crossing[0]), ("over", *crossing), ("from", crossing[1], end)
    ]  # fmt: skip
    lanes, drivable, crossings = [], [], []
    low, high = -mine - 0.5, same - mine - 0.5
    others_on_route = dice.random() < 0.6
    for name, begin, until in pieces:
        for number in range(-mine, same - mine + oncoming):
            right, left = (number - 0.5) * road.width, (number + 0.5) * road.width
            is_same = number < same - mine
            on_route = number == 0 or (is_same and others_on_route)
            lanes.append(Lane(f"{name}_{number}", road.strip(begin, until, right, left), on_route))
        if name == "over":
            continue
        shoulder = dice.random()
        drivable.append(road.strip(begin, until, low * road.width - shoulder, high * road.width))
        if oncoming:
            drivable.append(road.strip(begin, until, high * road.width, (high + oncoming) * road.width))
    if crossing is not None:
        wide = _between(dice, 5, 15)
        crossings.append(
            road.strip(*crossing, low * road.width - wide, (high + oncoming) * road.width + wide)
        )
        middle = (crossing[0] + crossing[1]) / 2
        lanes.append(Lane("across", road.strip(middle - 3.5, middle, -40, 40), False))
    if dice.random() < 0.2:
        begin = _between(dice, 0, 40)
        drivable.append(road.strip(begin, begin + 15, low * road.width - 9, low * road.width))
    return lanes, drivable, crossings, crossing


def _track(
    dice: Random, road: _Road, name: str, path: Path, shape: tuple[float, float], agent: bool
) -> TrackedBox:
    poses = np.zeros((LONG_STEPS + 1, 3))
    for step in range(LONG_STEPS + 1):
        along, left = path(0.1 * step)
        before, aside = path(0.1 * step - 0.05)
        after, beyond = path(0.1 * step + 0.05)
        x, y, heading = road.at(along, left)
        moved = math.hypot(after - before, beyond - aside)
        poses[step] = x, y, heading + (math.atan2(beyond - aside, after - before) if moved > 1e-3 else 0.0)
    first = 0
    if dice.random() < 0.12:
        first = int(_between(dice, 1, 30))
        poses[:first] = np.nan
    elif dice.random() < 0.12:
        poses[int(_between(dice, 5, 45)) :] = np.nan
    (along, left), (before, aside) = path(0.1 * first + 0.05), path(0.1 * first - 0.05)
    speed = math.hypot(along - before, left - aside) / 0.1 if agent else 0.0
    return TrackedBox(name, agent, *shape, poses, speed)


def _tracks(
    dice: Random, road: _Road, ego_mps: float, crossing: tuple[float, float] | None
) -> list[TrackedBox]:
    tracks = []
    for number in range(int(7 * dice.random())):
        kind = dice.random()
        car = (_between(dice, 3.8, 5.5), _between(dice, 1.7, 2.1))
        near, side = _between(dice, 7, 40), road.width * (1 if dice.random() < 0.5 else -1)
        drift = _between(dice, -0.4, 0.4)
        pace = ego_mps * _between(dice, 0.2, 1.2)
        agent = True
        path: Path
        if kind < 0.25:  # ahead, and it may stop
            brake = _between(dice, 0, 4) if dice.random() < 0.6 else 0.0

            def path(
                t: float, s: float = near, v: float = pace, b: float = brake, d: float = drift
            ) -> tuple[float, float]:
                until = min(t, v / b) if b > 0 else t
                return s + v * until - b * until * until / 2, d

        elif kind < 0.4:  # cuts in
            begin = _between(dice, 0, 2)
            gap = _between(dice, 3, 20)

            def path(
                t: float, s: float = gap, v: float = pace, b: float = begin, d: float = side
            ) -> tuple[float, float]:
                return s + v * t, d * (1 - _smooth((t - b) / 2))

        elif kind < 0.55:  # towards the ego

            def path(
                t: float, s: float = near + 20, v: float = pace + 2, d: float = abs(side) + drift
            ) -> tuple[float, float]:
                return s - v * t, d

        elif kind < 0.68:  # from behind, faster
            lag, fast = _between(dice, 5, 15), ego_mps + _between(dice, 0, 6)
            lane = 0.0 if dice.random() < 0.6 else side

            def path(
                t: float, s: float = -lag, v: float = fast, d: float = lane + drift
            ) -> tuple[float, float]:
                return s + v * t, d

        elif kind < 0.8:  # across the road
            car = car if crossing is not None else (0.7, 0.7)
            place = near if crossing is None else (crossing[0] + crossing[1]) / 2
            slow = _between(dice, 0.8, 2) if crossing is None else _between(dice, 2, 9)
            begin = _between(dice, 4, 20)

            def path(
                t: float, s: float = place, v: float = slow, b: float = begin, d: float = side
            ) -> tuple[float, float]:
                return s, math.copysign(b, d) - math.copysign(v, d) * t

        elif kind < 0.9:  # stands at the side

            def path(t: float, s: float = near, d: float = side * 0.75 + drift) -> tuple[float, float]:
                return s, d

        else:  # a thing on the road
            agent = False
            car = (_between(dice, 0.3, 2.5), _between(dice, 0.3, 0.8))

            def path(t: float, s: float = near, d: float = 3 * drift) -> tuple[float, float]:
                return s, d

        tracks.append(_track(dice, road, f"track_{number}", path, car, agent))
    return tracks


def _smooth(share: float) -> float:
    share = min(max(share, 0.0), 1.0)
    return share * share * (3 - 2 * share)


def _plan(dice: Random, road: _Road, speed: float, count: int, every: float, tame: bool = False) -> Array:
    kind = 0.0 if tame else dice.random()
    gain, shift, over = _between(dice, -1.0, 1.0), 0.0, _between(dice, 2, 4)
    if tame:
        gain = _between(dice, -0.5, 1.0)
    elif kind < 0.15:  # stops
        gain = -_between(dice, 2, 6)
    elif kind < 0.25:  # hurries
        gain = _between(dice, 1, 4)
    elif kind < 0.5:  # changes the lane
        shift = road.width * (1 if dice.random() < 0.5 else -1) * _between(dice, 0.7, 1.2)
    elif kind < 0.6:  # leaves the road, or comes close to doing so
        shift = _between(dice, -12, 12)
    elif kind < 0.68:  # drives backwards
        gain, speed = -_between(dice, 0, 1), -_between(dice, 0.2, 3)
    elif kind < 0.73:  # stands
        gain, speed = 0.0, _between(dice, -0.05, 0.05)
    jitter = _between(dice, 0, 0.3) if kind > 0.9 else 0.0
    backwards = speed < 0
    poses = np.zeros((count, 3))
    for row in range(count):
        t = (row + 1) * every
        until = t
        if gain < 0 and not backwards and speed > 0:
            until = min(t, -speed / gain)
        along = speed * until + gain * until * until / 2
        left = -road.offset + (road.offset + shift) * _smooth(t / over)
        x, y, heading = road.at(along, left)
        slope = (road.offset + shift) * 6 * (t / over) * (1 - t / over) / over if t < over else 0.0
        pace = abs(speed + gain * until)
        heading += math.atan2(slope, pace) if pace > 1 else 0.0
        noise = [_between(dice, -jitter, jitter) for _ in range(3)]
        poses[row] = x + noise[0], y + noise[1], heading + 0.1 * noise[2]
    return poses
