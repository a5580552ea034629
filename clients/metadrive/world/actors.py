"""What moves or stands in an episode: vehicles on rails, pedestrians, cones and barriers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from looktwice.clients.metadrive.world.roads import Array, Rail
from looktwice.model.driving.scene import AgentKind

STEP_S: Final = 0.1
BODY_SIZES: Final[dict[str, tuple[float, float, float]]] = {
    "beetle": (4.25, 1.70, 1.55),
    "130": (4.85, 1.98, 1.50),
    "pedestrian": (0.6, 0.6, 1.78),
    "cone": (0.5, 0.5, 0.8),
    "barrier": (0.5, 1.9, 1.0),
}
"""Length, width and height of each model as it is drawn."""
VEHICLE_MODELS: Final = ("beetle", "130")


@dataclass
class Body:
    """What every actor has: a place in the world and along the route."""

    actor_id: int
    kind: AgentKind
    model: str
    x: float
    y: float
    heading: float
    speed: float
    progress: float
    oncoming_s: float = 0.0
    tint: float = 0.5
    phase: float = 0.0

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width, height."""
        return BODY_SIZES[self.model]


@dataclass
class StillBody(Body):
    """A cone or a barrier."""


@dataclass
class Pedestrian(Body):
    """Someone at the roadside who may walk across: from ``start`` towards ``heading``."""

    walking_speed: float = 1.3
    crosses: bool = True
    walk_m: float = 0.0
    """How far the way across is."""
    walked_m: float = 0.0
    walking: bool = False
    eagerness_s: float = 1.0

    def step(self) -> None:
        """Walk on for one step."""
        self.speed = self.walking_speed if self.walking else 0.0
        if not self.walking:
            return
        moved = self.walking_speed * STEP_S
        self.x += moved * math.cos(self.heading)
        self.y += moved * math.sin(self.heading)
        self.walked_m += moved
        self.phase += moved
        if self.walked_m >= self.walk_m:
            self.walking = False
            self.crosses = False


def smooth_step(u: float) -> tuple[float, float]:
    """The quintic from 0 to 1 with flat ends, and its slope."""
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10 - 15 * u + 6 * u * u), 30 * u * u * (1 - u) ** 2


@dataclass
class Shift:
    """A lane change under way: the offset fades from ``offset`` at ``start_s`` to 0 after ``length``."""

    start_s: float
    offset: float
    length: float


@dataclass
class Drift:
    """A vehicle that strays from its line by ``offset`` within ``out`` metres, and comes back in ``back``."""

    start_s: float
    offset: float
    out: float
    back: float

    def at(self, s: float) -> tuple[float, float]:
        """The stray to the left at ``s``, and its slope."""
        away, away_rate = smooth_step((s - self.start_s) / self.out)
        home, home_rate = smooth_step((s - self.start_s - self.out) / self.back)
        return self.offset * (away - home), self.offset * (away_rate / self.out - home_rate / self.back)


@dataclass
class Vehicle(Body):
    """A vehicle that runs along a rail of its route, beside it by a smooth offset."""

    rail: int = 0
    s: float = 0.0
    acceleration: float = 0.0
    shift: Shift | None = None
    drift: Drift | None = None
    heedless: bool = False
    """Does not heed what it should brake for."""
    wander_m: float = 0.0
    on_route: bool = True
    hazard_lights: bool = False
    indicator: int = 0
    """1: left, -1: right."""
    stopped_for_s: float = 0.0
    hold: bool = False
    """Stands until released."""
    brake_until_s: float = -100.0
    brake_to: float = 0.0
    brake_rate: float = 0.0
    seen: bool = False
    gone: bool = False
    rng_phase: float = field(default=0.0)

    def wander(self, s: float) -> tuple[float, float]:
        """The natural sway in the lane at ``s`` and its slope."""
        a, p = self.wander_m, self.rng_phase
        sway = a * (math.sin(s / 31 + p) + 0.5 * math.sin(s / 17 + 2.3 * p))
        return sway, a * (math.cos(s / 31 + p) / 31 + 0.5 * math.cos(s / 17 + 2.3 * p) / 17)

    def offset_at(self, s: float) -> tuple[float, float]:
        """The planned offset from the rail at ``s`` and its slope."""
        offset, slope = self.wander(s)
        if self.shift is not None:
            done, rate = smooth_step((s - self.shift.start_s) / self.shift.length)
            offset += self.shift.offset * (1 - done)
            slope -= self.shift.offset * rate / self.shift.length
        if self.drift is not None:
            stray, rate = self.drift.at(s)
            offset, slope = offset + stray, slope + rate
        return offset, slope

    def offsets_at(self, s: Array) -> Array:
        """Planned offsets at many arc lengths, without the sway."""
        if self.shift is None:
            return np.zeros_like(s)
        u = np.clip((s - self.shift.start_s) / self.shift.length, 0, 1)
        fading: Array = self.shift.offset * (1 - u**3 * (10 - 15 * u + 6 * u * u))
        return fading

    def place(self, rails: tuple[Rail, ...]) -> None:
        """Bring x, y, heading and progress up to date with rail, s and offset."""
        rail = rails[self.rail]
        offset, slope = self.offset_at(self.s)
        self.x, self.y, heading = rail.pose(self.s, offset)
        index = min(max(int(self.s * 2), 0), len(rail.curvature) - 1)
        self.heading = heading + math.atan2(slope, 1 - offset * float(rail.curvature[index]))
        self.progress = rail.progress(self.s)

    def advance(self, rails: tuple[Rail, ...], acceleration: float, backing_out: bool = False) -> None:
        """Move one step at ``acceleration``; only who is backing out rolls backwards."""
        speed = self.speed + acceleration * STEP_S
        if not backing_out and (speed < 0 or (speed < 0.05 and acceleration <= 0)):
            speed = 0.0
        self.s += 0.5 * (self.speed + speed) * STEP_S
        self.acceleration = (speed - self.speed) / STEP_S
        self.speed = speed
        self.stopped_for_s = self.stopped_for_s + STEP_S if abs(speed) < 0.1 else 0.0
        if self.shift is not None and self.s > self.shift.start_s + self.shift.length:
            self.shift = None
            self.indicator = 0
        if self.drift is not None and self.s > self.drift.start_s + self.drift.out + self.drift.back:
            self.drift = None
        self.place(rails)
        if self.s > rails[self.rail].length - 3.0:
            self.gone = True

    def change_to(self, rails: tuple[Rail, ...], rail: int, length: float) -> None:
        """Begin to move over to another rail within ``length`` metres."""
        near = np.array([rails[rail].s_at(self.progress)])
        s, offset = rails[rail].project(np.array([[self.x, self.y]]), near)
        sway, _ = self.wander(float(s[0]))
        self.rail, self.s = rail, float(s[0])
        # A stray is taken along as a part of the way over.
        self.shift, self.drift = Shift(self.s, float(offset[0]) - sway, length), None
        self.indicator = 1 if offset[0] < 0 else -1
