"""The expert: follows the route, keeps clear of what it can see, goes round what blocks its lane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from looktwice.clients.metadrive.world.actors import Body, Vehicle
from looktwice.clients.metadrive.world.car_following import (
    RailView,
    SpeedLimits,
    Style,
    fixed_ahead,
    has_room,
    in_path,
    look,
    neighbours,
    smoothed,
    wanted_acceleration,
)
from looktwice.clients.metadrive.world.late_braking import LateBraking
from looktwice.clients.metadrive.world.roads import RoadMap

_ROUND_M: Final = 11.0
"""Room needed ahead to steer round an obstacle from standstill."""
_SWERVE_S: Final = 2.2
"""Into the next lane in less than this, a car would corner at more than 4.2 m/s²."""
_REVERSE_SPEED: Final = 1.4
_TURN_PREPARATION_M: Final = 140.0
_SLOW_LEADER: Final = 2.0


@dataclass
class _Memory:
    slow_for_s: float = 0.0
    blocked_for_s: float = 0.0
    reversing: bool = False
    settled_s: float = 0.0


class Expert:
    """Decides speed and lane of one vehicle; with ``ambition`` it overtakes and prepares turns.

    ``lapses`` make it brake late now and then.
    """

    def __init__(
        self,
        road_map: RoadMap,
        style: Style,
        limits: SpeedLimits,
        ambition: bool,
        eager: bool,
        lapses: LateBraking | None = None,
    ) -> None:
        self._map = road_map
        self.style = style
        self._limits = limits
        self._ambition = ambition
        self._eager = eager
        self._lapses = lapses
        self._memory = _Memory()
        self._took_over = False

    @property
    def reversing(self) -> bool:
        """Whether it is backing out."""
        return self._memory.reversing

    def take_over(self) -> None:
        """Begin anew, where somebody else has driven: what it has in mind is of another time.

        It has not chosen to be so near to what blocks its lane or to who steps out, and brakes where it would
        have to swerve, or could no longer stop.
        """
        self._memory = _Memory()
        self._took_over = True

    def step(self, me: Vehicle, bodies: list[Body]) -> None:
        """Decide and move one step."""
        rails = self._map.rails if me.on_route else self._map.oncoming_rails
        view = look(me, rails[me.rail], bodies)
        if me.on_route and not (self._lapses is not None and self._lapses.absorbed(me)):
            rail = self._lane_decision(me, view, bodies)
            if rail is not None:
                view = look(me, rails[me.rail], bodies)
        if self._memory.reversing:
            me.advance(rails, self._backing_out(me, view), backing_out=True)
            return
        limit = self._limits.at(me.rail, me.s + 0.4 * me.speed)
        wanted = wanted_acceleration(
            me, self.style, limit, view, stands_off=self._ambition, took_over=self._took_over
        )
        if self._lapses is not None:
            wanted = self._lapses.heeded(me, limit, wanted)
        me.advance(rails, smoothed(me, self.style, wanted))

    def _lane_decision(self, me: Vehicle, view: RailView, bodies: list[Body]) -> int | None:
        memory = self._memory
        memory.settled_s = 0.0 if me.shift is not None else memory.settled_s + 0.1
        blocked = fixed_ahead(me, view, max(40.0, 5.5 * me.speed))
        if blocked is not None:
            memory.blocked_for_s += 0.1
            return self._go_round(me, view, bodies, blocked)
        memory.blocked_for_s = 0.0
        memory.reversing = False
        if not self._ambition or me.shift is not None or memory.settled_s < 1.5:
            return None
        wish = self._wished_side(me)
        if wish is not None:
            rail = self._map.neighbour(me.rail, me.progress, wish)
            return self._try(me, rail, bodies, 4.2)
        self._watch_leader(me, view)
        if self._eager and memory.slow_for_s > 1.8 and self._metres_to_turn(me) > 230:
            for rail in neighbours(me, self._map):
                if self._is_faster(me, rail, bodies) and self._try(me, rail, bodies, 4.2) is not None:
                    memory.slow_for_s = 0.0
                    return rail
        return None

    def _go_round(self, me: Vehicle, view: RailView, bodies: list[Body], blocked: float) -> int | None:
        memory = self._memory
        if me.shift is not None and not (me.speed < 0.2 and me.stopped_for_s > 2):
            return None
        near = blocked < _ROUND_M
        options = neighbours(me, self._map)
        if near and me.speed < 0.1 and self._ambition and memory.blocked_for_s > 2.5 and options:
            memory.reversing = memory.reversing or (me.stopped_for_s > 2.0 and _clear_behind(me, view))
            return None
        if near and not (memory.reversing and blocked > _ROUND_M - 0.5):
            return None
        if memory.reversing:
            if blocked < _ROUND_M + 0.8:
                return None
            memory.reversing = False
        if self._took_over and blocked < _SWERVE_S * me.speed:
            return None
        for rail in sorted(options, key=lambda r: self._blocked_on(me, r, bodies)):
            if self._blocked_on(me, rail, bodies) < blocked + 30:
                continue
            if has_room(me, self._map, self._map.rails, rail, bodies):
                length = min(max(3.6 * me.speed, _ROUND_M), blocked + 0.5)
                me.change_to(self._map.rails, rail, length)
                return rail
        return None

    def _blocked_on(self, me: Vehicle, rail: int, bodies: list[Body]) -> float:
        target = self._map.rails[rail]
        view = look(me, target, bodies)
        s = target.s_at(me.progress)
        ahead = view.fixed & (view.s > s - 6) & (np.abs(view.offset) < 1.75)
        return float((view.s - s)[ahead].min()) if ahead.any() else 200.0

    def _backing_out(self, me: Vehicle, view: RailView) -> float:
        blocked = fixed_ahead(me, view, 40.0)
        done = blocked is None or blocked > _ROUND_M + 0.6 or not _clear_behind(me, view)
        target = 0.0 if done else -_REVERSE_SPEED
        change = min(max(target - me.speed, -0.8 * 0.1), 1.2 * 0.1)
        if done and abs(me.speed) < 0.05:
            self._memory.reversing = False
            return -me.speed / 0.1
        return change / 0.1

    def _wished_side(self, me: Vehicle) -> int | None:
        """The side to move to for the next turn of the route: 1 left, -1 right."""
        here = self._map.route_index(me.progress)
        if self._map.roads[self._map.route[here]].turn is not None:
            return None
        for index in range(here + 1, len(self._map.route)):
            if self._map.road_starts[index] - me.progress > _TURN_PREPARATION_M:
                return None
            turn = self._map.roads[self._map.route[index]].turn
            if turn in ("left", "right"):
                side = 1 if turn == "left" else -1
                return side if self._map.neighbour(me.rail, me.progress, side) is not None else None
        return None

    def _metres_to_turn(self, me: Vehicle) -> float:
        here = self._map.route_index(me.progress)
        for index in range(here, len(self._map.route)):
            if self._map.roads[self._map.route[index]].turn in ("left", "right", "ring"):
                return self._map.road_starts[index] - me.progress
        return 1000.0

    def _watch_leader(self, me: Vehicle, view: RailView) -> None:
        ahead = np.flatnonzero(in_path(me, view))
        slow = False
        if len(ahead):
            first = ahead[np.argmin(view.s[ahead])]
            wish = min(self.style.speed, self._limits.at(me.rail, me.s + 10))
            slow = (
                view.s[first] - me.s < 15 + 1.8 * me.speed and 1.0 < view.along[first] < wish - _SLOW_LEADER
            )
        self._memory.slow_for_s = self._memory.slow_for_s + 0.1 if slow else 0.0

    def _is_faster(self, me: Vehicle, rail: int, bodies: list[Body]) -> bool:
        target = self._map.rails[rail]
        view = look(me, target, bodies)
        gap = view.s - target.s_at(me.progress)
        inside = (np.abs(view.offset) < 1.7) & (gap > 0) & (gap < 25 + 2.5 * me.speed)
        return not bool((inside & (view.along < me.speed + 2)).any())

    def _try(self, me: Vehicle, rail: int | None, bodies: list[Body], seconds: float) -> int | None:
        if rail is None or me.speed < 2.0 or self._blocked_on(me, rail, bodies) < 70:
            return None
        if not has_room(me, self._map, self._map.rails, rail, bodies):
            return None
        me.change_to(self._map.rails, rail, max(seconds * me.speed, 16.0))
        return rail


def _clear_behind(me: Vehicle, view: RailView) -> bool:
    behind = (view.s < me.s) & (view.s > me.s - 14) & (np.abs(view.offset) < 2.2)
    return not bool(behind.any())


def varied(style: Style, rng: np.random.Generator) -> Style:
    """``style`` with one person's habits."""
    return replace(
        style,
        headway_s=float(rng.uniform(0.9, 1.7)),
        acceleration=float(rng.uniform(1.5, 2.4)),
        standstill_m=float(rng.uniform(2.2, 4.0)),
        lateral=float(rng.uniform(2.0, 3.0)),
    )
