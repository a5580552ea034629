"""The thoughts that a labelled scene teaches, by rule (ELF-VLA, supplement, section 7.2).

Who is told of must be visible in the front cameras now. What they do next is what they did: that is the truth
which a model learns to predict. Thresholds are ours, as the paper publishes none.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.agents import ROAD_USERS, Agent
from looktwice.model.driving.high_level import action_of
from looktwice.model.driving.labeller import LANE_MOVING
from looktwice.model.driving.lane_graph import LaneGraph, LanePath
from looktwice.model.driving.lead import LANE_HALF_WIDTH_M
from looktwice.model.driving.phrases import Side, State
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, LabelledScene
from looktwice.model.driving.seen import SLOWER_BY_MS, STANDING_MS, estimated_m
from looktwice.model.driving.sentences import EDGE_FARTHEST_M, EDGE_STEP_M
from looktwice.model.driving.thoughts import (
    Beside,
    Crosser,
    Crossing,
    Edges,
    Leader,
    Merging,
    Obstacle,
    ObstacleKind,
    Origin,
    Road,
    Thoughts,
)
from looktwice.model.driving.tracks import Track, track_of
from looktwice.model.driving.trajectory import STEP_S, FloatArray, present_speed
from looktwice.model.driving.view import bend_along, beside_of, visible

Array = npt.NDArray[np.float64]

LEADS_WITHIN_M: Final = 60.0
"""A vehicle farther away leaves more than 3 s even at 70 km/h."""
MERGES_WITHIN_M: Final = 40.0
"""Metres ahead within which somebody beside may merge: 3 s at 50 km/h."""
BESIDE_M: Final = 2.0
"""Who is ahead by less, from bumper to bumper, is beside the ego."""
CROSSES_WITHIN_M: Final = 60.0
"""Who comes into the way farther ahead is no reason to act yet, as with leaders."""
FORESIGHT_S: Final = 3.0
"""Who is in the own lane within this, merges; whose crossing lies no farther from the ego's, interacts."""
_SLOWEST_MS: Final = 2.0
"""An ego that waits is expected at a crossing as if it set off at this speed."""
_MERGE_POINT_M: Final = 1.0


@dataclass(frozen=True)
class _Placed:
    """An agent relative to the ego's lane: ``left_m`` of its middle, ``along_m`` and ``gap_m`` ahead."""

    agent: Agent
    track: Track
    along_m: float
    left_m: float
    along_ms: float
    left_ms: float

    @property
    def gap_m(self) -> float:
        """From bumper to bumper along the lane, 0 beside the ego."""
        return max(0.0, self.along_m - (EGO_LENGTH_M + self.track.length_m) / 2)

    @property
    def in_lane(self) -> bool:
        return abs(self.left_m) < LANE_HALF_WIDTH_M


def thoughts_of(labelled: LabelledScene) -> Thoughts | None:
    """The thoughts of a scene's expert.

    None where the scene has no annotated road, or the expert drives on no lane: then nothing can be said.
    """
    graph = LaneGraph(labelled.lane_lines)
    way = graph.path_along(np.concatenate([np.zeros((1, 2)), labelled.future[:, :2].astype(np.float64)]))
    action = action_of(labelled.future, graph)
    if way is None or action is None or not labelled.drivable:
        return None
    speed_ms = present_speed(labelled.scene.history)
    placed = _placed(labelled.agents, way)
    leader = _leader(placed)
    merging = _merging(placed, graph, way, speed_ms)
    known = {id(each.agent) for each in (leader, merging) if each is not None}
    return Thoughts(
        edges=edges_of(labelled.drivable),
        leader=None if leader is None else Leader(_state(leader, speed_ms), estimated_m(leader.gap_m)),
        merging=None if merging is None else Merging(_side(merging.left_m), _merges_at(merging)),
        crossing=_crossing([each for each in placed if id(each.agent) not in known], way, speed_ms),
        road=_road(graph, way),
        obstacle=_obstacle(placed),
        action=action,
    )


def edges_of(drivable: Iterable[FloatArray]) -> Edges:
    """How near the edges of the road are to the ego's sides now.

    Args:
        drivable: rings as of a `LabelledScene`; both distances are 0 where they do not contain the ego.
    """
    return Edges(*map(_told_edge, edge_distances(drivable)))


def edge_distances(drivable: Iterable[FloatArray]) -> tuple[float, float]:
    """Metres from the ego's left and right side to the edge of the road now; infinite where there is none.

    Args:
        drivable: rings as of a `LabelledScene`; both distances are 0 where they do not contain the ego.
    """
    rings = [ring.astype(np.float64) for ring in drivable]
    middle, front, rear = (_crossings(rings, x) for x in (0.0, EGO_LENGTH_M / 2, -EGO_LENGTH_M / 2))
    if np.count_nonzero(middle > 0) % 2 == 0:
        return 0.0, 0.0
    beside = np.concatenate([middle, front, rear])
    left, right = (
        max(0.0, float(side.min(initial=math.inf)) - EGO_WIDTH_M / 2)
        for side in (beside[beside > 0], -beside[beside <= 0])
    )
    return left, right


def _crossings(rings: Iterable[Array], x: float) -> Array:
    """Where edges of rings cross the line across the ego ``x`` m ahead of its middle: metres to its left."""
    found = [np.zeros(0)]
    for ring in rings:
        start, end = ring, np.roll(ring, -1, axis=0)
        crossed = (start[:, 0] <= x) != (end[:, 0] <= x)
        start, step = start[crossed], (end - start)[crossed]
        found.append(start[:, 1] + (x - start[:, 0]) / step[:, 0] * step[:, 1])
    return np.concatenate(found)


def _told_edge(nearest_m: float) -> float | None:
    steps = round(nearest_m / EDGE_STEP_M) if math.isfinite(nearest_m) else math.inf
    return None if steps * EDGE_STEP_M > EDGE_FARTHEST_M else steps * EDGE_STEP_M


def _placed(agents: tuple[Agent, ...], way: LanePath) -> list[_Placed]:
    """Visible agents relative to the ego's lane, the nearest along it first."""
    found = []
    known = [(agent, track) for agent in agents if (track := track_of(agent)) is not None]
    tracks = [track for _, track in known]
    for agent, track in known:
        if not visible(track, tracks):
            continue
        point = np.array([[track.x_m, track.y_m]])
        along_m, left_m = way.frame.places(point)[0]
        turned = track.heading_rad - way.frame.headings(point)[0]
        along_ms, left_ms = track.speed_ms * math.cos(turned), track.speed_ms * math.sin(turned)
        found.append(_Placed(agent, track, float(along_m), float(left_m), along_ms, left_ms))
    return sorted(found, key=lambda each: each.along_m)


def _leader(placed: Iterable[_Placed]) -> _Placed | None:
    return next(
        (
            each
            for each in placed
            if each.track.kind == "vehicle"
            and each.in_lane
            and each.along_m > 0
            and each.gap_m < LEADS_WITHIN_M
            and each.along_ms > -STANDING_MS
        ),
        None,
    )


def _state(leader: _Placed, speed_ms: float) -> State:
    if leader.along_ms < STANDING_MS:
        return "standing"
    if "brake" in leader.track.lights:
        return "braking"
    return "slower" if leader.along_ms < speed_ms - SLOWER_BY_MS else ""


def _merging(placed: Iterable[_Placed], graph: LaneGraph, way: LanePath, speed_ms: float) -> _Placed | None:
    """The nearest vehicle in a lane beside that moves over, signals to, or whose lane ends in the ego's."""
    for each in placed:
        beside = LANE_HALF_WIDTH_M <= abs(each.left_m) < 3 * LANE_HALF_WIDTH_M
        moves_along = each.track.kind == "vehicle" and each.along_ms > STANDING_MS
        near = each.along_m > 0 and each.gap_m < MERGES_WITHIN_M
        if not (beside and moves_along and near):
            continue
        if _comes_over(each) or _signals(each) or _lanes_merge(each, graph, way, speed_ms):
            return each
    return None


def _comes_over(each: _Placed) -> bool:
    """Whether its side, at its speed across, is in the own lane within `FORESIGHT_S`."""
    towards_ms = -math.copysign(each.left_ms, each.left_ms * each.left_m)
    away_m = abs(each.left_m) - LANE_HALF_WIDTH_M - each.track.width_m / 2
    return towards_ms > LANE_MOVING and away_m < towards_ms * FORESIGHT_S


def _signals(each: _Placed) -> bool:
    lights = each.track.lights
    towards = "right" if each.left_m > 0 else "left"
    # Both are hazard lights.
    return towards in lights and not {"left", "right"} <= lights


def _lanes_merge(each: _Placed, graph: LaneGraph, way: LanePath, speed_ms: float) -> bool:
    """Whether its lane leads into the ego's, and both are there within `FORESIGHT_S` of each other."""
    point = np.array([each.track.x_m, each.track.y_m])
    for lane in graph.lanes_at(point, each.track.heading_rad):
        if lane not in way.lanes and set(graph.follows(lane)) & set(way.lanes):
            end_m, left_m = way.frame.places(graph.lines[lane][-1:])[0]
            ours_s = end_m / max(speed_ms, _SLOWEST_MS)
            theirs_s = (end_m - each.along_m) / each.along_ms
            if abs(left_m) < _MERGE_POINT_M and abs(ours_s - theirs_s) < FORESIGHT_S:
                return True
    return False


def _crossing(placed: Iterable[_Placed], way: LanePath, speed_ms: float) -> Crossing | None:
    """Who comes into the ego's way soonest, as it goes on along its lane at its speed."""
    speed_ms = max(speed_ms, _SLOWEST_MS)
    found = [
        crossing
        for each in placed
        if each.track.kind in ROAD_USERS and (crossing := _crosses(each, way, speed_ms)) is not None
    ]
    return min(found, key=lambda each: each[0])[1] if found else None


def _crosses(each: _Placed, way: LanePath, speed_ms: float) -> tuple[float, Crossing] | None:
    """When the agent comes into the ego's way, and what there is to tell of it."""
    kind: Crosser = "pedestrian" if each.track.kind == "pedestrian" else "vehicle"
    if each.in_lane:
        if each.along_ms > -STANDING_MS or kind == "pedestrian" or not each.along_m > 0:
            return None
        meets_s = each.gap_m / (speed_ms - each.along_ms)
        if meets_s > FORESIGHT_S:
            return None
        return meets_s, Crossing(kind, "oncoming", estimated_m(each.gap_m), first=False)
    future = each.agent.future[:, :2].astype(np.float64)
    there = np.isfinite(future[:, 0])
    if not there.any():
        return None
    along_m, left_m = way.frame.places(future[there]).T
    there_s = STEP_S * (1 + np.flatnonzero(there))
    ours_s = along_m / speed_ms
    half_m = (EGO_WIDTH_M + each.track.width_m) / 2
    reach = (along_m > EGO_LENGTH_M / 2) & (along_m < CROSSES_WITHIN_M)
    enters = reach & (np.abs(left_m) < half_m) & (np.abs(there_s - ours_s) < FORESIGHT_S)
    if not enters.any():
        return None
    first = int(enters.argmax())
    ahead_m = max(0.0, float(along_m[first]) - EGO_LENGTH_M / 2)
    origin: Origin = _side(each.left_m)
    before = bool(there_s[first] < ours_s[first])
    return float(there_s[first]), Crossing(kind, origin, estimated_m(ahead_m), before)


def _road(graph: LaneGraph, way: LanePath) -> Road:
    bend, bend_m = bend_along(way.ahead)
    sides = beside_of(list(graph.lines))
    beside: Beside = "none" if not sides else "both" if len(sides) == 2 else min(sides)
    return Road(bend, None if bend is None else estimated_m(bend_m), beside)


def _obstacle(placed: Iterable[_Placed]) -> Obstacle | None:
    kinds: dict[str, ObstacleKind] = {"cone": "cone", "barrier": "barrier", "pedestrian": "pedestrian"}
    for each in placed:
        kind = kinds.get(each.track.kind)
        still = abs(each.track.speed_ms) < STANDING_MS
        if kind is not None and still and each.in_lane and each.along_m > 0 and each.gap_m < LEADS_WITHIN_M:
            return Obstacle(kind, estimated_m(each.gap_m))
    return None


def _side(left_m: float) -> Side:
    return "left" if left_m > 0 else "right"


def _merges_at(merging: _Placed) -> int:
    return 0 if merging.gap_m < BESIDE_M else estimated_m(merging.gap_m)
