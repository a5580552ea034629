"""Where plans lie on the map: area flags, driving direction, lane keeping, progress, red lights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from looktwice.model.driving.pdm.geometry import Boxes, IndexArray, Points, area_meets, beside_line, on_line
from looktwice.model.driving.pdm.world import STEPS, Array, BoolArray, World

DIRECTION_STEPS: Final = 11
"""Steps of the window over which driving against the traffic is summed: 1 s and the step before."""
DIRECTION_FINE_M: Final = 2.0
DIRECTION_WORST_M: Final = 6.0
LANE_OFFSET_M: Final = 0.5
LANE_STEPS: Final = 20
_CENTRE: Final = 4
_AXLE: Final = 5
"""Behind the corners, among the points of a box."""


@dataclass(frozen=True, eq=False)
class Areas:
    """Where plans are, bool [n, 41] each; None where the layer is not known.

    Attributes:
        several_lanes: no lane holds all corners, and more than one holds some; taken for granted in careful
            worlds where lanes or the drivable area are not known.
        off_road: a corner lies nowhere where a car may be.
        off_route: the centre lies in no lane of the route.
        crossing: the centre lies in an intersection.
        axle_crossing: the rear axle lies in an intersection.
    """

    several_lanes: BoolArray | None
    off_road: BoolArray | None
    off_route: BoolArray | None
    crossing: BoolArray | None
    axle_crossing: BoolArray | None

    @property
    def outside(self) -> BoolArray | None:
        """In several lanes or off the road, as far as is known; None where neither is."""
        known = [each for each in (self.several_lanes, self.off_road) if each is not None]
        return np.logical_or.reduce(known) if known else None

    @property
    def outside_is_known(self) -> bool:
        """Whether what `outside` denies is certain."""
        return self.several_lanes is not None and self.off_road is not None


def areas_of(ego: Boxes, axles: Array, world: World) -> Areas:
    """The areas of ego boxes [n, 41] with rear axles [n, 41, 2]."""
    # Four corners, the centre and the rear axle of each box, looked up in all areas at once.
    centres = np.stack([ego.x, ego.y], axis=-1)
    points = np.concatenate([ego.corners(), centres[:, :, None], axles[:, :, None]], axis=2)
    layers = (
        [lane.area for lane in world.lanes or ()],
        list(world.drivable or ()),
        list(world.intersections or ()),
    )
    every = [area for layer in layers for area in layer]
    inside = Points(points.reshape(-1, 2)).inside_each(every).reshape(len(every), *points.shape[:3])
    lanes, drivable, crossings = np.split(inside, np.cumsum([len(layer) for layer in layers])[:-1])
    several_lanes: BoolArray | None = None
    off_road: BoolArray | None = None
    off_route: BoolArray | None = None
    crossing: BoolArray | None = None
    axle_crossing: BoolArray | None = None
    if world.lanes is not None:
        held = lanes[..., :_CENTRE].sum(axis=-1)
        several_lanes = ((held > 0).sum(axis=0) > 1) & ~_any(held == 4)
        on_route = [lane.on_route for lane in world.lanes]
        off_route = ~_any(lanes[on_route, ..., _CENTRE])
    if world.careful and (world.lanes is None or world.drivable is None):
        several_lanes = np.ones(ego.x.shape, dtype=np.bool_)
    if world.drivable is not None:
        off_road = _any(np.moveaxis(~(_any(drivable) | _any(crossings))[..., :_CENTRE], -1, 0))
    if world.intersections is not None:
        crossing = _any(crossings[..., _CENTRE])
        axle_crossing = _any(crossings[..., _AXLE])
    return Areas(several_lanes, off_road, off_route, crossing, axle_crossing)


def _any(flags: BoolArray) -> BoolArray:
    """Whether a flag is set in any of the first axis."""
    result: BoolArray = np.logical_or.reduce(flags, axis=0)
    return result


def driven_against(ego: Boxes, against: BoolArray) -> Array:
    """Metres driven ``against`` (bool [n, 41]) within the last second, [n, 41]."""
    driven = np.zeros(ego.x.shape)
    driven[:, 1:] = np.hypot(np.diff(ego.x, axis=1), np.diff(ego.y, axis=1))
    driven[~against] = 0.0
    padded = np.pad(driven, ((0, 0), (DIRECTION_STEPS - 1, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, DIRECTION_STEPS, axis=1)
    result: Array = windows.sum(axis=-1)
    return result


def direction_scores(against_m: Array) -> Array:
    """1, 0.5 or 0 of what `driven_against` tells, [n]."""
    worst = against_m.max(axis=1)
    return np.where(worst < DIRECTION_FINE_M, 1.0, np.where(worst < DIRECTION_WORST_M, 0.5, 0.0))


def lane_losses(ego: Boxes, crossing: BoolArray, centreline: Array) -> IndexArray:
    """The step at which each plan has been beside the centre line for 2 s, [n]; -1 where it never has.

    Steps within an intersection count neither way: they do not end a row of steps beside the line.
    """
    shape = ego.x.shape
    centres = np.stack([ego.x, ego.y], axis=-1).reshape(-1, 2)
    beside = beside_line(centres, centreline, LANE_OFFSET_M).reshape(shape)
    counted = np.cumsum(~crossing, axis=1)
    in_lane = np.maximum.accumulate(np.where(~crossing & ~beside, counted, 0), axis=1)
    lost = ~crossing & (counted - in_lane >= LANE_STEPS)
    return np.where(lost.any(axis=1), lost.argmax(axis=1), -1)


def progress_m(ego: Boxes, centreline: Array) -> Array:
    """Metres that plans get along the centre line, never less than 0, [n]."""
    ends = np.stack([ego.x[:, [0, -1]], ego.y[:, [0, -1]]], axis=-1).reshape(-1, 2)
    along = on_line(ends, centreline).along_m.reshape(-1, 2)
    result: Array = np.clip(along[:, 1] - along[:, 0], 0.0, None)
    return result


def red_light_steps(ego: Boxes, world: World) -> tuple[IndexArray, IndexArray]:
    """The first step on a red light's lane, [n], and which light; -1 where none is met."""
    count = len(ego.x)
    first, which = np.full(count, STEPS + 1), np.full(count, -1)
    for number, light in enumerate(world.lights or ()):
        met = area_meets(light.area, ego.flat()).reshape(ego.x.shape)
        if light.red is not None:
            met &= light.red
        step = np.where(met.any(axis=1), met.argmax(axis=1), STEPS + 1)
        which[step < first] = number
        first = np.minimum(first, step)
    return np.where(which < 0, -1, first), which
