"""Lanes of a map, and the rails that vehicles follow along a route."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
import shapely

Array = npt.NDArray[np.float64]
LineMark = Literal["none", "broken", "solid"]
Turn = Literal["straight", "left", "right", "ring"]

RAIL_SPACING_M: Final = 0.5
ROAD_MARGIN_M: Final = 0.3
"""How much wider than its lanes a road is: the edge line lies on asphalt."""
_CLOSING_M: Final = 2.5
_SMOOTHING_M: Final = 3.0
_SEARCH_M: Final = 18.0
_SEARCHED: Final = np.arange(-int(_SEARCH_M / RAIL_SPACING_M), int(_SEARCH_M / RAIL_SPACING_M) + 1)
"""Points around the one where a place on a rail is guessed."""
_SMALL_HOLE_M2: Final = 80.0


@dataclass(frozen=True, eq=False)
class RoadLane:
    """One lane of one road; ``number`` 0 is the leftmost."""

    lane_id: int
    road: int
    number: int
    centre: Array
    width: float
    left_mark: LineMark
    right_mark: LineMark

    @cached_property
    def length(self) -> float:
        """Metres along the centre line."""
        return float(np.hypot(*np.diff(self.centre, axis=0).T).sum())

    def edge(self, offset_m: float) -> Array:
        """The line ``offset_m`` to the left of the centre line."""
        tangent = np.gradient(self.centre, axis=0)
        tangent /= np.maximum(np.hypot(tangent[:, 0], tangent[:, 1])[:, None], 1e-9)
        shifted: Array = self.centre + offset_m * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        return shifted

    @cached_property
    def polygon(self) -> Any:
        """The lane's surface."""
        ring = np.concatenate([self.edge(self.width / 2), self.edge(-self.width / 2)[::-1]])
        return shapely.Polygon(ring).buffer(0)


@dataclass(frozen=True, eq=False)
class RoadSegment:
    """A run of parallel lanes between two nodes of the map; ``turn`` is set on junction roads."""

    road_id: int
    start: str
    end: str
    lanes: tuple[int, ...]
    turn: Turn | None


@dataclass(frozen=True, eq=False)
class Rail:
    """A smooth line through successive lanes of a route, with arc length ``s``.

    ``progress`` runs along the route and is shared by all rails of the route.
    """

    points: Array
    heading: Array
    curvature: Array
    lane_ids: tuple[int, ...]
    breaks_s: Array
    breaks_progress: Array

    @cached_property
    def columns(self) -> tuple[Array, Array]:
        """x and y of the points, each in one piece: a simulated step looks them up hundreds of times."""
        return np.ascontiguousarray(self.points[:, 0]), np.ascontiguousarray(self.points[:, 1])

    @property
    def length(self) -> float:
        """Metres."""
        return RAIL_SPACING_M * (len(self.points) - 1)

    def progress(self, s: float) -> float:
        """Route progress at arc length ``s``."""
        return float(np.interp(s, self.breaks_s, self.breaks_progress))

    def s_at(self, progress: float) -> float:
        """Arc length at route ``progress``."""
        return float(np.interp(progress, self.breaks_progress, self.breaks_s))

    def covers(self, progress: float, margin: float = 0.0) -> bool:
        """Whether the rail exists at ``progress``."""
        return bool(self.breaks_progress[0] + margin <= progress <= self.breaks_progress[-1] - margin)

    def lane_at(self, s: float) -> int:
        """The lane at arc length ``s``."""
        index = int(np.searchsorted(self.breaks_s, s, side="right")) - 1
        return self.lane_ids[min(max(index, 0), len(self.lane_ids) - 1)]

    def pose(self, s: float, offset: float = 0.0) -> tuple[float, float, float]:
        """x, y and heading at ``s``, ``offset`` metres to the left."""
        at = min(max(s / RAIL_SPACING_M, 0.0), len(self.points) - 1.001)
        i = int(at)
        w = at - i
        heading = self.heading[i] + w * (self.heading[i + 1] - self.heading[i])
        x = self.points[i, 0] + w * (self.points[i + 1, 0] - self.points[i, 0]) - offset * np.sin(heading)
        y = self.points[i, 1] + w * (self.points[i + 1, 1] - self.points[i, 1]) + offset * np.cos(heading)
        return float(x), float(y), float(heading)

    def at(self, s: Array) -> Array:
        """Points [n, 2] at arc lengths ``s`` [n]."""
        grid = RAIL_SPACING_M * np.arange(len(self.points))
        return np.stack(
            [np.interp(s, grid, self.points[:, 0]), np.interp(s, grid, self.points[:, 1])], axis=1
        )

    def project(self, xy: Array, near_s: Array) -> tuple[Array, Array]:
        """Arc length [n] and offset to the left [n] of points [n, 2], searched around ``near_s`` [n]."""
        last = len(self.points) - 1
        first = np.minimum(np.maximum((near_s / RAIL_SPACING_M).astype(int), 0), last)
        window = np.minimum(np.maximum(first[:, None] + _SEARCHED, 0), last)
        xs, ys = self.columns
        apart_x, apart_y = xy[:, :1] - xs[window], xy[:, 1:] - ys[window]
        best = np.argmin(apart_x * apart_x + apart_y * apart_y, axis=1)
        index = window[np.arange(len(xy)), best]
        gap_x, gap_y, heading = xy[:, 0] - xs[index], xy[:, 1] - ys[index], self.heading[index]
        cos, sin = np.cos(heading), np.sin(heading)
        return index * RAIL_SPACING_M + (gap_x * cos + gap_y * sin), -gap_x * sin + gap_y * cos


def _resampled(points: Array, spacing: float) -> Array:
    step = np.hypot(*np.diff(points, axis=0).T)
    points = np.concatenate([points[:1], points[1:][step > 1e-6]])
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    grid = np.arange(0.0, s[-1], spacing)
    return np.stack([np.interp(grid, s, points[:, 0]), np.interp(grid, s, points[:, 1])], axis=1)


def make_rail(lanes: list[RoadLane], starts: list[float], lengths: list[float]) -> Rail:
    """The rail through ``lanes``; road i of the route begins at progress ``starts[i]``."""
    raw = _resampled(np.concatenate([lane.centre for lane in lanes]), RAIL_SPACING_M)
    half = int(_SMOOTHING_M / RAIL_SPACING_M)
    kernel = np.hanning(2 * half + 3)[1:-1]
    kernel /= kernel.sum()
    before = raw[0] - (raw[1] - raw[0]) * np.arange(half, 0, -1)[:, None]
    after = raw[-1] + (raw[-1] - raw[-2]) * np.arange(1, half + 1)[:, None]
    padded = np.concatenate([before, raw, after])
    smooth = np.stack([np.convolve(padded[:, axis], kernel, "valid") for axis in (0, 1)], axis=1)
    points = _resampled(smooth, RAIL_SPACING_M)
    tangent = np.gradient(points, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    curvature = np.gradient(heading) / RAIL_SPACING_M
    curvature = np.convolve(np.pad(curvature, 3, mode="edge"), np.full(7, 1 / 7), "valid")
    breaks_s = np.concatenate([[0.0], np.cumsum([lane.length for lane in lanes])])
    breaks_s *= RAIL_SPACING_M * (len(points) - 1) / breaks_s[-1]
    breaks_progress = np.array([*starts, starts[-1] + lengths[-1]])
    return Rail(points, heading, curvature, tuple(lane.lane_id for lane in lanes), breaks_s, breaks_progress)


@dataclass(frozen=True, eq=False)
class RoadMap:
    """Everything that does not move: lanes, roads, the ego's route and the way of oncoming traffic."""

    lanes: tuple[RoadLane, ...]
    roads: tuple[RoadSegment, ...]
    route: tuple[int, ...]
    oncoming: tuple[int, ...]
    blocks: str
    rails: tuple[Rail, ...] = field(default=())
    oncoming_rails: tuple[Rail, ...] = field(default=())

    @cached_property
    def drivable(self) -> Any:
        """The road surface as one shapely geometry: lanes, a margin, and the gaps inside junctions."""
        union = shapely.union_all([lane.polygon.buffer(0.05) for lane in self.lanes]).simplify(0.02)
        closed = union.buffer(_CLOSING_M).buffer(ROAD_MARGIN_M - _CLOSING_M)
        parts = getattr(closed, "geoms", [closed])
        filled = [
            shapely.Polygon(
                part.exterior,
                [hole for hole in part.interiors if shapely.Polygon(hole).area > _SMALL_HOLE_M2],
            )
            for part in parts
        ]
        return shapely.union_all(filled).simplify(0.03)

    @cached_property
    def length(self) -> float:
        """Route length in metres of progress."""
        return max(float(rail.breaks_progress[-1]) for rail in self.rails)

    @cached_property
    def road_starts(self) -> list[float]:
        """Progress at which each road of the route begins."""
        starts, at = [], 0.0
        for road in self.route:
            starts.append(at)
            at += self.road_length(road)
        return starts

    def road_length(self, road: int) -> float:
        """Mean length of a road's lanes."""
        return float(np.mean([self.lanes[lane].length for lane in self.roads[road].lanes]))

    def route_index(self, progress: float) -> int:
        """Position in the route of the road at ``progress``."""
        index = int(np.searchsorted(self.road_starts, progress, side="right")) - 1
        return min(max(index, 0), len(self.route) - 1)

    def rail_of_lane(self, lane: int) -> int | None:
        """The ego-route rail that runs through ``lane``."""
        return next((i for i, rail in enumerate(self.rails) if lane in rail.lane_ids), None)

    def neighbour(self, rail: int, progress: float, side: int) -> int | None:
        """The rail one lane to the left (``side`` 1) or right (-1) at ``progress``; None without one."""
        current = self.rails[rail]
        lane = self.lanes[current.lane_at(current.s_at(progress))]
        lanes = self.roads[lane.road].lanes
        wanted = lane.number - side
        if not 0 <= wanted < len(lanes):
            return None
        found = self.rail_of_lane(lanes[wanted])
        return found if found is not None and self.rails[found].covers(progress, 1.0) else None


def with_rails(road_map: RoadMap) -> RoadMap:
    """``road_map`` with the rails of its two routes laid out."""
    return RoadMap(
        road_map.lanes,
        road_map.roads,
        road_map.route,
        road_map.oncoming,
        road_map.blocks,
        _rails_along(road_map, road_map.route),
        _rails_along(road_map, road_map.oncoming),
    )


def _rails_along(road_map: RoadMap, route: tuple[int, ...]) -> tuple[Rail, ...]:
    lengths = [road_map.road_length(road) for road in route]
    starts = list(np.concatenate([[0.0], np.cumsum(lengths)[:-1]])) if route else []
    taken: set[int] = set()
    rails = []
    for first in range(len(route)):
        for lane_id in road_map.roads[route[first]].lanes:
            if lane_id in taken:
                continue
            chain = [road_map.lanes[lane_id]]
            for road in route[first + 1 :]:
                follower = _successor(road_map, chain[-1], road)
                if follower is None or follower.lane_id in taken:
                    break
                chain.append(follower)
            taken.update(lane.lane_id for lane in chain)
            last = first + len(chain)
            if sum(lane.length for lane in chain) > 10.0:
                rails.append(make_rail(chain, starts[first:last], lengths[first:last]))
    return tuple(rails)


def _successor(road_map: RoadMap, lane: RoadLane, road: int) -> RoadLane | None:
    for candidate in road_map.roads[road].lanes:
        following = road_map.lanes[candidate]
        if np.hypot(*(following.centre[0] - lane.centre[-1])) < 0.4:
            return following
    return None
