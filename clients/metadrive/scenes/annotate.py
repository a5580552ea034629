"""What the simulator knows about a moment: tags, the route ahead, and per-pixel targets."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from looktwice.clients.metadrive.world.episode_log import ActorLog, EpisodeLog
from looktwice.clients.metadrive.world.roads import Array, Rail
from looktwice.model.driving.cameras import CameraSpec
from looktwice.model.driving.scene import SEMANTIC_CLASSES, DenseTarget, Tag
from looktwice.model.driving.trajectory import FUTURE_STEPS, ROUTE_POINTS, ROUTE_SPACING_M

LEAD_WITHIN_M: Final = 40.0
LEAD_OFFSET_M: Final = 1.6
CUT_IN_WITHIN_M: Final = 30.0
CUT_IN_PAST_STEPS: Final = 16
CUT_IN_FUTURE_STEPS: Final = 30
CUT_IN_LINE_M: Final = 1.7
PEDESTRIAN_WITHIN_M: Final = 40.0
PEDESTRIAN_OFFSET_M: Final = 6.0
TURN_RAD: Final = 0.35
HARD_BRAKE: Final = 2.5
HARD_BRAKE_STEPS: Final = 3

DENSE_CELL_PX: Final = 4
"""Dense targets have one value for each square of this many pixels: 56 x 28 for 224 x 112."""
_BOX_MARGIN_M: Final = 0.25
_BOX_FOOT_M: Final = 0.12
_MERGE_M: Final = (75.0, 25.0)
"""The route moves to the lane of a turn between these distances before it."""

_CLASS: Final = {name: position for position, name in enumerate(SEMANTIC_CLASSES)}
_KIND_CLASS: Final = {
    "vehicle": _CLASS["vehicle"],
    "pedestrian": _CLASS["pedestrian"],
    "cone": _CLASS["obstacle"],
    "barrier": _CLASS["obstacle"],
}


def to_ego(points: Array, ego: Array) -> Array:
    """World points [..., 2] in the frame of ``ego`` (x, y, heading, ...)."""
    delta = points - ego[:2]
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    return np.stack(
        [cos * delta[..., 0] + sin * delta[..., 1], -sin * delta[..., 0] + cos * delta[..., 1]], axis=-1
    )


class Tagger:
    """Tags of an episode's steps; vehicles are measured along the rail that the ego follows."""

    def __init__(self, log: EpisodeLog) -> None:
        self._log = log
        self._speed = log.ego[:, 3]
        self._heading = np.unwrap(log.ego[:, 2])
        self._vehicles = [actor for actor in log.actors if actor.kind == "vehicle"]
        self._people = [actor for actor in log.actors if actor.kind == "pedestrian"]

    def tags(self, step: int) -> frozenset[Tag]:
        """What makes the scene at ``step`` difficult."""
        found: set[Tag] = set()
        until = step + FUTURE_STEPS
        if self._any_ahead(self._vehicles, step, LEAD_WITHIN_M, LEAD_OFFSET_M):
            found.add("lead_vehicle")
        if self._any_ahead(self._people, step, PEDESTRIAN_WITHIN_M, PEDESTRIAN_OFFSET_M):
            found.add("pedestrian")
        if any(self._cuts_in(actor, step) for actor in self._vehicles):
            found.add("cut_in")
        lanes = [self._log.road_map.lanes[lane] for lane in self._log.lanes[step : until + 1]]
        if any(a.road == b.road and a.number != b.number for a, b in pairwise(lanes)):
            found.add("lane_change")
        if abs(self._heading[until] - self._heading[step]) > TURN_RAD:
            found.add("turn")
        braking = np.diff(self._speed[step : until + 1]) * 10 < -HARD_BRAKE
        if np.convolve(braking, np.ones(HARD_BRAKE_STEPS), "valid").max(initial=0) >= HARD_BRAKE_STEPS:
            found.add("hard_brake")
        return frozenset(found)

    def _rail(self, step: int) -> tuple[Rail, float]:
        rail = self._log.road_map.rails[int(self._log.rails[step])]
        return rail, rail.s_at(float(self._log.progress[step]))

    def _any_ahead(self, actors: list[ActorLog], step: int, within: float, offset: float) -> bool:
        rail, s = self._rail(step)
        xy = np.array([actor.poses[step, :2] for actor in actors]).reshape(-1, 2)
        near = np.isfinite(xy[:, 0])
        near[near] = np.hypot(*(xy[near] - self._log.ego[step, :2]).T) < within + 5
        if not near.any():
            return False
        ahead = to_ego(xy[near], self._log.ego[step])[:, 0]
        along, beside = rail.project(xy[near], s + np.clip(ahead, -within, within))
        return bool(((along > s + 1) & (along < s + within) & (np.abs(beside) < offset)).any())

    def _cuts_in(self, actor: ActorLog, step: int) -> bool:
        steps = np.arange(
            max(step - CUT_IN_PAST_STEPS, 0), min(step + CUT_IN_FUTURE_STEPS, len(self._log.ego)), 2
        )
        steps = steps[np.isfinite(actor.poses[steps, 0])]
        if len(steps) < 2:
            return False
        gap = np.hypot(*(actor.poses[steps, :2] - self._log.ego[steps, :2]).T)
        if gap.min() > CUT_IN_WITHIN_M + 5:
            return False
        rail, _ = self._rail(step)
        mine = np.array([rail.s_at(float(p)) for p in self._log.progress[steps]])
        if (self._log.rails[steps] != self._log.rails[step]).any():
            return False
        along, beside = rail.project(actor.poses[steps, :2], mine + np.clip(gap, 0, CUT_IN_WITHIN_M + 10))
        outside = np.abs(beside) > CUT_IN_LINE_M
        enters = outside[:-1] & ~outside[1:] & (np.abs(beside[:-1]) < 2.6)
        ahead = (along - mine)[1:]
        return bool((enters & (ahead > 2) & (ahead < CUT_IN_WITHIN_M)).any())


def route_ahead(log: EpisodeLog, step: int) -> npt.NDArray[np.float32]:
    """The way to go [20, 2] in the ego frame: `route_line` at the spacing of a route."""
    points = route_line(log, step, 0.0, 100.0)
    apart = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    wanted = ROUTE_SPACING_M * np.arange(1, ROUTE_POINTS + 1)
    even = np.stack([np.interp(wanted, apart, points[:, 0]), np.interp(wanted, apart, points[:, 1])], axis=1)
    return to_ego(even, log.ego[step]).astype(np.float32)


def route_line(log: EpisodeLog, step: int, behind_m: float, ahead_m: float) -> Array:
    """The way to go [k, 2] in the world: the present lane's centre, the turn's lane before a turn.

    It follows the map and the navigation only: nothing the expert does about others shows in it.

    Args:
        log: the episode.
        step: when in it.
        behind_m: whole metres of progress before the ego's place that the line begins.
        ahead_m: metres of progress beyond it that the line ends.
    """
    road_map = log.road_map
    lane = int(log.lanes[step])
    rail = road_map.rail_of_lane(lane)
    if rail is None:
        rail = int(log.rails[step])
    start = float(log.progress[step])
    progress = np.arange(start - behind_m, start + ahead_m, 1.0)
    points = _along(road_map.rails[rail], progress)
    target = _turn_rail(log, rail, start)
    if target is not None:
        other, at = target
        u = np.clip((progress - (at - _MERGE_M[0])) / (_MERGE_M[0] - _MERGE_M[1]), 0, 1)
        u = np.clip(u, 0, np.clip((progress - start) / 30.0, 0, 1))
        w = (u**3 * (10 - 15 * u + 6 * u * u))[:, None]
        points = (1 - w) * points + w * _along(road_map.rails[other], progress)
    return points


def _along(rail: Rail, progress: Array) -> Array:
    """Points of ``rail`` at many places of the route; straight on past its ends."""
    s = np.interp(progress, rail.breaks_progress, rail.breaks_s)
    beyond = np.maximum(progress - rail.breaks_progress[-1], 0)
    points = rail.at(s)
    heading = rail.heading[-1]
    extended: Array = points + beyond[:, None] * np.array([np.cos(heading), np.sin(heading)])
    return extended


def _turn_rail(log: EpisodeLog, rail: int, start: float) -> tuple[int, float] | None:
    road_map = log.road_map
    here = road_map.route_index(start)
    if road_map.roads[road_map.route[here]].turn is not None:
        return None
    own_end = float(road_map.rails[rail].breaks_progress[-1])
    for index in range(here + 1, len(road_map.route)):
        at = road_map.road_starts[index]
        if at - start > 100:
            break
        road = road_map.roads[road_map.route[index]]
        lanes = road_map.roads[road_map.route[index - 1]].lanes
        if own_end <= at + 1:
            inner = [road_map.rail_of_lane(lane) for lane in lanes]
            lasting = [r for r in inner if r is not None and road_map.rails[r].breaks_progress[-1] > at + 5]
            return (lasting[-1], at) if lasting else None
        if road.turn in ("left", "right"):
            wanted = road_map.rail_of_lane(lanes[0] if road.turn == "left" else lanes[-1])
            return None if wanted is None or wanted == rail else (wanted, at)
    return None


def dense_target(
    spec: CameraSpec, depth_m: npt.NDArray[np.float32], log: EpisodeLog, step: int, drivable: Any
) -> DenseTarget:
    """What each cell of the picture at ``step`` shows; ``drivable`` is the road in the ego frame."""
    half = DENSE_CELL_PX // 2
    depth = depth_m[half::DENSE_CELL_PX, half::DENSE_CELL_PX]
    rows, columns = np.indices(depth.shape)
    seen = np.isfinite(depth)
    metres = np.where(seen, depth, 0.0)
    points = spec.unproject(
        columns * DENSE_CELL_PX + half + 0.5, rows * DENSE_CELL_PX + half + 0.5, metres.astype(np.float64)
    )
    classes = np.full(depth.shape, _CLASS["off_road"], np.uint8)
    classes[shapely.contains_xy(drivable, points[..., 0], points[..., 1]) & (points[..., 2] < 1.0)] = _CLASS[
        "road"
    ]
    for actor in log.actors:
        pose = actor.poses[step]
        if not np.isfinite(pose[0]) or np.hypot(*(pose[:2] - log.ego[step, :2])) > 150:
            continue
        x, y = to_ego(pose[:2], log.ego[step])
        turn = pose[2] - log.ego[step, 2]
        dx, dy = points[..., 0] - x, points[..., 1] - y
        along = dx * np.cos(turn) + dy * np.sin(turn)
        across = -dx * np.sin(turn) + dy * np.cos(turn)
        length, width, height = actor.size
        margin = _BOX_MARGIN_M + 0.004 * float(np.hypot(x, y))
        inside = (np.abs(along) < length / 2 + margin) & (np.abs(across) < width / 2 + margin)
        inside &= (points[..., 2] > _BOX_FOOT_M) & (points[..., 2] < height + margin)
        classes[inside] = _KIND_CLASS[actor.kind]
    classes[~seen] = _CLASS["sky"]
    return DenseTarget(spec.name, classes, metres.astype(np.float32))
