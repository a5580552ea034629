"""How a vehicle keeps its distance and finds room to change lanes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.clients.metadrive.world.actors import STEP_S, Body, Pedestrian, StillBody, Vehicle
from looktwice.clients.metadrive.world.roads import RAIL_SPACING_M, Array, Rail, RoadMap

COMFORT_BRAKE: Final = 3.5
EMERGENCY_BRAKE: Final = 6.0
CURVE_BRAKE: Final = 1.3
_STAND_OFF_M: Final = 9.0
"""Extra distance kept to something that has to be driven round."""
_CUT_IN_LOOKAHEAD_S: Final = 1.2
_SIDE_MARGIN_M: Final = 0.3
_SIGHT_M: Final = 90.0
_PEDESTRIAN_CORRIDOR_M: Final = 2.1
_PEDESTRIAN_GAP_M: Final = 3.5


@dataclass(frozen=True)
class Style:
    """How someone drives: wished speed, following time, comfort."""

    speed: float
    headway_s: float = 1.3
    acceleration: float = 1.6
    standstill_m: float = 2.8
    lateral: float = 2.2
    jerk: float = 4.5


@dataclass
class RailView:
    """The others as arrays in the coordinates of one rail."""

    bodies: list[Body]
    s: Array
    offset: Array
    along: Array
    """Speed along the rail."""
    across: Array
    """Speed to the left."""
    length: Array
    width: Array
    fixed: npt.NDArray[np.bool_]
    """Has to be driven round: cones, barriers, broken-down vehicles."""
    person: npt.NDArray[np.bool_]


def look(me: Vehicle, rail: Rail, bodies: list[Body]) -> RailView:
    """What ``me`` sees of ``bodies`` on ``rail``."""
    mine = rail.s_at(me.progress) if me.on_route else me.s
    others = [
        body
        for body in bodies
        if body is not me and not (isinstance(body, Vehicle) and body.on_route != me.on_route)
    ]
    if me.on_route:
        guessed = np.interp([body.progress for body in others], rail.breaks_progress, rail.breaks_s)
    else:
        guessed = np.array([_oncoming_s(body) for body in others], np.float64)
    ahead = guessed - mine
    near = (ahead > -70) & (ahead < _SIGHT_M + 15)
    seen = [body for body, is_near in zip(others, near.tolist(), strict=True) if is_near]
    told = np.array([(b.x, b.y, b.heading, b.speed, *b.size[:2]) for b in seen], np.float64).reshape(-1, 6)
    s, offset = rail.project(told[:, :2], guessed[near])
    heading, speed, length, width = told[:, 2:].T
    index = np.minimum(np.maximum((s / RAIL_SPACING_M).astype(int), 0), len(rail.heading) - 1)
    angle = heading - rail.heading[index]
    cos, sin = np.cos(angle), np.sin(angle)
    along, across = np.abs(cos), np.abs(sin)
    return RailView(
        seen,
        s,
        offset,
        speed * cos,
        speed * sin,
        length * along + width * across,
        width * along + length * across,
        np.array(
            [isinstance(b, StillBody) or (isinstance(b, Vehicle) and b.hazard_lights) for b in seen], bool
        ),
        np.array([isinstance(b, Pedestrian) for b in seen], bool),
    )


def _oncoming_s(body: Body) -> float:
    return body.s if isinstance(body, Vehicle) else body.oncoming_s


class SpeedLimits:
    """The speed that curves allow along each rail, braking gently ahead of them."""

    def __init__(self, rails: tuple[Rail, ...], lateral: float) -> None:
        self._limits = [_curve_speeds(rail, lateral) for rail in rails]

    def at(self, rail: int, s: float) -> float:
        """The limit at arc length ``s``."""
        limits = self._limits[rail]
        return float(limits[min(max(int(s / RAIL_SPACING_M), 0), len(limits) - 1)])


def _curve_speeds(rail: Rail, lateral: float) -> Array:
    squared = lateral / np.maximum(np.abs(rail.curvature), 1e-4)
    for i in range(len(squared) - 2, -1, -1):
        squared[i] = min(squared[i], squared[i + 1] + 2 * CURVE_BRAKE * RAIL_SPACING_M)
    limits: Array = np.sqrt(squared)
    return limits


def in_path(me: Vehicle, view: RailView) -> npt.NDArray[np.bool_]:
    """Which of the seen lie ahead on the way that ``me`` is going to take."""
    ahead = view.s > me.s + 0.5
    touching = view.s - 0.5 * view.length - 0.3 * me.size[0]
    mine = me.offsets_at(touching)
    reach = 0.5 * (view.width + me.size[1]) + (0.1 if me.shift is not None else _SIDE_MARGIN_M)
    coming = view.offset + view.across * _CUT_IN_LOOKAHEAD_S
    moving_in = (np.abs(coming - mine) < reach) & (np.abs(view.offset - mine) < 4.5) & ~view.person
    near = np.abs(view.offset - mine) < reach
    mask: npt.NDArray[np.bool_] = ahead & (near | moving_in) & ~view.person
    return mask


def wanted_acceleration(
    me: Vehicle,
    style: Style,
    limit: float,
    view: RailView,
    *,
    stands_off: bool = True,
    took_over: bool = False,
) -> float:
    """The acceleration that suits the road, the vehicles ahead and people about to be in the way.

    Args:
        me: who drives.
        style: how.
        limit: of speed, in m/s.
        view: who is around.
        stands_off: keep farther behind what has to be driven round.
        took_over: somebody else has driven until now, so people may be nearer than they can be yielded to.
    """
    speed = max(me.speed, 0.0)
    wish = min(style.speed, limit)
    if speed <= wish:
        wanted = style.acceleration * (1 - (speed / max(wish, 0.5)) ** 4)
    else:
        wanted = max(-2.5, 1.2 * (wish - speed))
    ahead = np.flatnonzero(in_path(me, view))
    if len(ahead):
        gap = view.s[ahead] - me.s - 0.5 * (view.length[ahead] + me.size[0])
        if stands_off:
            gap = gap - _STAND_OFF_M * view.fixed[ahead]
        wanted = min(wanted, float(_following(style, speed, gap, view.along[ahead]).min()))
    stop = _yield_distance(me, view, took_over)
    if stop is not None:
        wanted = min(wanted, float(_following(style, speed, np.array([stop + 2.0]), np.zeros(1))[0]))
    return wanted


def _following(style: Style, speed: float, gap: Array, lead_speed: Array) -> Array:
    gap = np.maximum(gap, 0.2)
    closing = speed - lead_speed
    reach = style.standstill_m + np.maximum(
        0.0, speed * style.headway_s + speed * closing / (2 * math.sqrt(style.acceleration * 2.0))
    )
    model = style.acceleration * (1 - (reach / gap) ** 2)
    # What physics needs to stop behind the leader: the model alone is too gentle far out, too hard near.
    room = np.maximum(gap - style.standstill_m, 0.1)
    lead_stop = np.maximum(lead_speed, 0) ** 2 / (2 * 3.5)
    needed = -(speed**2) / (2 * np.maximum(room + lead_stop, 0.3))
    harsh: Array = np.where(model < -2.0, np.maximum(model, np.minimum(1.15 * needed, -2.0)), model)
    return np.minimum(np.maximum(harsh, -EMERGENCY_BRAKE), style.acceleration)


def _yield_distance(me: Vehicle, view: RailView, took_over: bool) -> float | None:
    """Metres to where ``me`` must stop for someone who is or will be in the way.

    Who steps out too near to be yielded to is passed, unless they would be hit: that is for who took over.
    """
    nearest: float | None = None
    for i in np.flatnonzero(view.person & (view.s > me.s + 1.0) & (view.s < me.s + _SIGHT_M)):
        distance = float(view.s[i] - me.s) - 0.5 * me.size[0]
        lateral = float(view.offset[i] - me.offsets_at(view.s[i : i + 1])[0])
        across = float(view.across[i])
        inside = abs(lateral) < _PEDESTRIAN_CORRIDOR_M
        leaving = lateral * across > 0 and abs(lateral) > 1.7
        approaching = lateral * across < 0
        enters_in = (abs(lateral) - _PEDESTRIAN_CORRIDOR_M) / max(abs(across), 0.1)
        arrives_in = distance / max(me.speed, 1.0)
        if (inside and not leaving) or (approaching and enters_in < arrives_in + 2.5):
            stop = max(distance - _PEDESTRIAN_GAP_M, 0.0)
            hit = took_over and (inside or enters_in < arrives_in)
            if hit or me.speed**2 / (2 * EMERGENCY_BRAKE) < distance:
                nearest = stop if nearest is None else min(nearest, stop)
    return nearest


def smoothed(me: Vehicle, style: Style, wanted: float) -> float:
    """``wanted`` within what comfort, jerk and standstill allow."""
    urgent = wanted < -COMFORT_BRAKE
    lowest = -EMERGENCY_BRAKE if urgent and me.speed > 2 else -COMFORT_BRAKE
    jerk = 9.0 if urgent else style.jerk
    change = min(max(wanted - me.acceleration, -jerk * STEP_S), style.jerk * STEP_S)
    acceleration = min(max(me.acceleration + change, lowest), 2.5)
    if 0 < me.speed < 1.5 and acceleration < 0:
        acceleration = max(acceleration, -(0.35 + 1.3 * me.speed))
    if me.speed < 0.1 and wanted < 0.25:
        return min(0.0, -me.speed / STEP_S)
    return acceleration


def fixed_ahead(me: Vehicle, view: RailView, reach_m: float) -> float | None:
    """Metres from bumper to the first thing in my lane that has to be driven round."""
    ahead = view.fixed & (view.s > me.s) & (view.s < me.s + reach_m) & (np.abs(view.offset) < 1.75)
    if not ahead.any():
        return None
    return float((view.s - 0.5 * view.length)[ahead].min() - me.s - 0.5 * me.size[0])


def has_room(me: Vehicle, road_map: RoadMap, rails: tuple[Rail, ...], rail: int, bodies: list[Body]) -> bool:
    """Whether the lane of ``rail`` beside ``me`` is free enough to move into, ahead and behind."""
    target = rails[rail]
    s = target.s_at(me.progress)
    if s + 40 > target.length:
        return False
    view = look(me, target, bodies)
    inside = np.abs(view.offset + 0.6 * view.across) < 0.5 * (view.width + 3.0)
    gap = view.s - s
    bumper = np.abs(gap) - 0.5 * (view.length + me.size[0])
    front = inside & (gap >= 0)
    speed = max(me.speed, 0.0)
    need = np.where(view.fixed, 45.0, 3.0 + 0.5 * speed + 1.2 * np.maximum(0, speed - view.along))
    if (front & (bumper < need)).any():
        return False
    rear = inside & (gap < 0)
    closing = np.maximum(0, view.along - speed)
    return not bool((rear & (bumper < 3.5 + 0.4 * view.along + 1.8 * closing)).any())


def neighbours(me: Vehicle, road_map: RoadMap) -> list[int]:
    """The rails to the left and right of ``me``; only vehicles on the route change lanes."""
    if not me.on_route or road_map.roads[road_map.route[road_map.route_index(me.progress)]].turn is not None:
        return []
    found = (road_map.neighbour(me.rail, me.progress, side) for side in (1, -1))
    return [rail for rail in found if rail is not None]
