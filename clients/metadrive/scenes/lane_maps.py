"""Lane maps of an episode: lanes and intersections around the ego, and the line of its route."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import shapely

from looktwice.clients.metadrive.scenes.annotate import route_line, to_ego
from looktwice.clients.metadrive.world.episode_log import EpisodeLog
from looktwice.clients.metadrive.world.roads import Array, RoadMap
from looktwice.model.driving.lane_map import LaneArea, LaneMap
from looktwice.model.driving.trajectory import FloatArray

REACH_M: Final = 80.0
AHEAD_M: Final = 45.0
"""Lanes and intersections within `REACH_M` of the place so far ahead are told of. At the speeds of these
roads, nobody gets out of that circle in the 4 s that are scored."""
LINE_BEHIND_M: Final = 20.0
LINE_AHEAD_M: Final = 160.0
_OVERLAP_M: Final = 0.08
"""Lanes are this much wider and longer than drawn: without it, hair-thin gaps between simplified outlines
would count as the wrong side of the road."""
_SIMPLIFY_M: Final = 0.06
_LINE_SIMPLIFY_M: Final = 0.02
_CLOSING_M: Final = 2.5
"""Gaps between the lanes of an intersection that belong to it are narrower than twice this."""
_SMALL_HOLE_M2: Final = 80.0


class LaneMaps:
    """Lane maps of an episode's steps; the outlines in the world are made once."""

    def __init__(self, log: EpisodeLog) -> None:
        self._log = log
        route = set(log.road_map.route)
        self._lanes = [
            (lane.lane_id, outline, lane.road in route)
            for lane in log.road_map.lanes
            for outline in _parts(lane.polygon.buffer(_OVERLAP_M, join_style="mitre").simplify(_SIMPLIFY_M))
        ]
        self._intersections = list(_parts(_intersections(log.road_map)))

    def at(self, step: int) -> LaneMap:
        """What lies around the ego at ``step``."""
        ego = self._log.ego[step]
        around = shapely.Point(ego[:2] + AHEAD_M * np.array([np.cos(ego[2]), np.sin(ego[2])]))
        line = shapely.LineString(route_line(self._log, step, LINE_BEHIND_M, LINE_AHEAD_M))
        return LaneMap(
            tuple(
                LaneArea(lane_id, _ring(outline.exterior, ego), on_route)
                for lane_id, outline, on_route in self._lanes
                if outline.distance(around) < REACH_M
            ),
            tuple(
                _ring(ring, ego)
                for area in self._intersections
                if area.distance(around) < REACH_M
                for ring in (area.exterior, *area.interiors)
            ),
            to_ego(np.asarray(line.simplify(_LINE_SIMPLIFY_M).coords), ego).astype(np.float32),
            # MetaDrive's blocks have no traffic lights.
            has_lights=False,
        )


def _ring(ring: Any, ego: Array) -> FloatArray:
    """A shapely ring as seen from ``ego``, counter-clockwise and not closed."""
    points = np.asarray(ring.coords)[:-1]
    return to_ego(points if ring.is_ccw else points[::-1], ego).astype(np.float32)


def _intersections(road_map: RoadMap) -> Any:
    """Where lanes cross: the ways over junctions and round roundabouts, with the gaps between them."""
    crossing = [
        road_map.lanes[lane].polygon
        for road in road_map.roads
        if road.turn is not None
        for lane in road.lanes
    ]
    closed = shapely.union_all(crossing).buffer(_CLOSING_M).buffer(-_CLOSING_M)
    filled = [
        shapely.Polygon(
            part.exterior, [hole for hole in part.interiors if shapely.Polygon(hole).area > _SMALL_HOLE_M2]
        )
        for part in _parts(closed)
    ]
    # An intersection counts as road: where nobody may drive, it must not reach, not even when simplified.
    road = road_map.drivable.buffer(-2 * _SIMPLIFY_M)
    return shapely.intersection(shapely.union_all(filled), road).simplify(_SIMPLIFY_M)


def _parts(area: Any) -> Iterator[Any]:
    for part in getattr(area, "geoms", [area]):
        if part.geom_type == "Polygon" and not part.is_empty:
            yield part
