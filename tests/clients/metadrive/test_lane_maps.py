"""Lane maps agree with what stands and drives on the road."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely

from looktwice.clients.metadrive.scenes.lane_maps import (
    AHEAD_M,
    LINE_AHEAD_M,
    REACH_M,
    LaneMaps,
    _intersections,
    _parts,
)
from looktwice.clients.metadrive.world.roads import RoadLane, RoadMap, RoadSegment, Turn
from looktwice.model.driving.lane_map import LaneMap
from looktwice.model.driving.pdm.geometry import crosses_itself
from looktwice.model.driving.pdm.labelled import plans_of, world_of
from looktwice.model.driving.pdm.scoring import COLLISIONS, DIRECTION, EXTENDED_COMFORT, LIGHTS, Others, score
from looktwice.model.driving.scene import LabelledScene
from tests.clients.metadrive.conftest import Filmed


def maps(filmed: Filmed) -> list[tuple[LabelledScene, LaneMap]]:
    assert filmed.scenes
    return [(labelled, labelled.lane_map) for labelled in filmed.scenes if labelled.lane_map is not None]


def area_of(rings: Any) -> Any:
    """Of rings by the even-odd rule."""
    area: Any = shapely.Polygon()
    for ring in rings:
        area = area.symmetric_difference(shapely.Polygon(ring))
    return area


def road(number: int, points: list[tuple[float, float]], turn: Turn | None) -> tuple[RoadLane, RoadSegment]:
    """A road of one lane, 4 m wide."""
    lane = RoadLane(number, number, 0, np.array(points, np.float64), 4.0, "none", "none")
    return lane, RoadSegment(number, f"{number}", f"{number}>", (number,), turn)


def test_an_intersection_is_where_ways_over_a_junction_lie() -> None:
    made = [
        road(0, [(-60, 0), (-10, 0)], None),
        road(1, [(-10, 0), (10, 0)], "straight"),
        road(2, [(0, -10), (0, 10)], "straight"),
        road(3, [(10, 0), (60, 0)], None),
    ]
    road_map = RoadMap(tuple(lane for lane, _ in made), tuple(each for _, each in made), (0, 1, 3), (), "X")
    (area,) = _parts(_intersections(road_map))
    inside = [(0, 0), (-9, 0), (9, 1.9), (0, 9)]
    outside = [(-11, 0), (11, 0), (8, 8), (0, 11)]
    assert [bool(area.contains(shapely.Point(point))) for point in inside] == [True] * 4
    assert [bool(area.contains(shapely.Point(point))) for point in outside] == [False] * 4


def test_every_scene_has_one_and_no_lights(filmed: Filmed) -> None:
    assert len(maps(filmed)) == len(filmed.scenes)
    assert not any(lane_map.has_lights for _, lane_map in maps(filmed))


def test_outlines_are_simple_and_lanes_counter_clockwise(filmed: Filmed) -> None:
    for _, lane_map in maps(filmed):
        for ring in (*(lane.ring for lane in lane_map.lanes), *lane_map.intersections):
            assert not crosses_itself(ring.astype(np.float64))
            assert shapely.LinearRing(ring).is_ccw
            assert (ring[0] != ring[-1]).any()


def test_lanes_and_intersections_lie_on_the_road(filmed: Filmed) -> None:
    for labelled, lane_map in maps(filmed)[::4]:
        road = area_of(labelled.drivable).buffer(0.1)
        around = shapely.Point(AHEAD_M, 0).buffer(REACH_M)
        outlines = [*(shapely.Polygon(lane.ring) for lane in lane_map.lanes), area_of(lane_map.intersections)]
        for outline in outlines:
            assert outline.intersection(around).difference(road).is_empty


def test_the_expert_keeps_to_lanes_of_its_route_and_lanes_leave_no_gaps(filmed: Filmed) -> None:
    for labelled, lane_map in maps(filmed):
        route = shapely.union_all([shapely.Polygon(lane.ring) for lane in lane_map.lanes if lane.on_route])
        driven = np.concatenate([labelled.scene.history[:, :2], labelled.future[:40, :2]])
        assert shapely.contains_xy(route, driven[:, 0], driven[:, 1]).all()


def test_whoever_drives_drives_along_the_lane_it_is_in(filmed: Filmed) -> None:
    """Vehicles in one lane only, outside intersections, head as that lane does; some come on other lanes."""
    lanes = filmed.log.road_map.lanes
    seen = {True: 0, False: 0}
    for labelled, lane_map in maps(filmed)[::2]:
        crossing = area_of(lane_map.intersections)
        step = int(labelled.scene.scene_id.split("-")[1])
        for agent in labelled.agents:
            x, y, heading = agent.present.astype(float)
            moved = np.hypot(*(agent.future[0, :2] - agent.present[:2]))
            if agent.kind != "vehicle" or not moved > 0.2 or crossing.contains(shapely.Point(x, y)):
                continue
            holding = [
                lane for lane in lane_map.lanes if shapely.Polygon(lane.ring).contains(shapely.Point(x, y))
            ]
            if len(holding) != 1:
                continue
            centre = lanes[holding[0].lane_id].centre
            world = filmed.log.ego[step]
            turn = np.array([[np.cos(world[2]), np.sin(world[2])], [-np.sin(world[2]), np.cos(world[2])]])
            line = (centre - world[:2]) @ turn.T
            nearest = min(int(np.hypot(*(line - [x, y]).T).argmin()), len(line) - 2)
            along = np.arctan2(*(line[nearest + 1] - line[nearest])[::-1])
            assert np.cos(heading - along) > 0.8
            seen[holding[0].on_route] += 1
    assert seen[True]


def test_the_route_lies_on_its_centre_line(filmed: Filmed) -> None:
    for labelled, lane_map in maps(filmed):
        line = shapely.LineString(lane_map.centreline)
        assert labelled.scene.route is not None
        assert max(line.distance(shapely.Point(point)) for point in labelled.scene.route) < 0.05
        assert line.project(shapely.Point(0, 0)) > 5.0
        assert line.length - line.project(shapely.Point(0, 0)) == pytest.approx(LINE_AHEAD_M, rel=0.1)
        assert line.distance(shapely.Point(0, 0)) < 2.2


def test_a_step_has_the_same_map_whoever_asks(filmed: Filmed) -> None:
    labelled, lane_map = maps(filmed)[3]
    again = LaneMaps(filmed.log).at(int(labelled.scene.scene_id.split("-")[1]))
    assert [lane.lane_id for lane in again.lanes] == [lane.lane_id for lane in lane_map.lanes]
    assert all(np.array_equal(a.ring, b.ring) for a, b in zip(again.lanes, lane_map.lanes, strict=True))


def test_all_of_epdms_is_known_but_what_another_plan_decides(filmed: Filmed) -> None:
    for labelled in filmed.scenes:
        expert = plans_of(labelled.future)
        others = Others(reference=expert, against="expert")
        found = score(world_of(labelled), expert[None], "v2.2", others, centre=True)
        assert found.missing == (EXTENDED_COMFORT,)
        for name in (COLLISIONS, DIRECTION, LIGHTS):
            value = found.sub_scores[name]
            assert value is not None
            assert value.tolist() == [1.0]
        assert score(world_of(labelled), expert[None], "v1.1", others, centre=True).missing == ()
