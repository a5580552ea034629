"""Why plans fail: at which sub-score, when, with whom, and by how much."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from looktwice.model.driving.pdm.collisions import LOOK_AHEAD, track_boxes
from looktwice.model.driving.pdm.comfort import Excess, excesses, extended_excesses
from looktwice.model.driving.pdm.geometry import (
    Boxes,
    IndexArray,
    Points,
    boxes_meet,
    gaps,
    on_line,
    to_edges,
)
from looktwice.model.driving.pdm.lanes import DIRECTION_FINE_M, LANE_OFFSET_M
from looktwice.model.driving.pdm.scoring import (
    COLLISIONS,
    COMFORT,
    DIRECTION,
    DRIVABLE,
    EXTENDED_COMFORT,
    LANE_KEEPING,
    LIGHTS,
    PROGRESS,
    TIME_TO_COLLISION,
    Failures,
    Others,
    Scores,
    ego_boxes,
)
from looktwice.model.driving.pdm.world import SPEED, SPEED_Y, STEP_S, STEPS, Area, Array, TrackedBox, World


@dataclass(frozen=True)
class Failure:
    """One sub-score at which a plan fails.

    Attributes:
        sub_score: its name.
        time_s: when it fails first.
        other_id: the track or the light with which; None where there is no other.
        distance_m: between the boxes then, 0 where they touch; how far the farthest corner is off the road;
            how far the centre is beside the centre line; how far was driven against the traffic within a
            second. None for lights and comfort, and for what will come too close and is not there yet.
        what: the bound that is broken, of comfort; "" otherwise.
    """

    sub_score: str
    time_s: float
    other_id: str | None
    distance_m: float | None
    what: str


def failures_of(world: World, scores: Scores) -> list[tuple[Failure, ...]]:
    """The failures of each plan in the order of time."""
    found: list[list[Failure]] = [[] for _ in scores.score]
    ego = ego_boxes(world, scores.states)
    names = (
        [track.track_id for track in world.tracks or ()],
        [light.light_id for light in world.lights or ()],
    )
    for name, failures in scores.failures.items():
        plans = np.flatnonzero(failures.step >= 0)
        steps, others = failures.step[plans], failures.other[plans]
        distances = _distances(world, name, failures, ego, plans, steps, others)
        for row, plan in enumerate(plans):
            other = names[name == LIGHTS][others[row]] if others[row] >= 0 else None
            distance = None if distances is None or np.isnan(distances[row]) else float(distances[row])
            what = failures.what[plan] if failures.what else ""
            found[plan].append(Failure(name, round(float(steps[row]) * STEP_S, 1), other, distance, what))
    return [tuple(sorted(each, key=lambda failure: failure.time_s)) for each in found]


def _distances(
    world: World,
    name: str,
    failures: Failures,
    ego: Boxes,
    plans: IndexArray,
    steps: IndexArray,
    others: IndexArray,
) -> Array | None:
    bodies = ego[plans, steps]
    if name in (COLLISIONS, TIME_TO_COLLISION) and world.tracks:
        there = track_boxes(world.tracks, STEPS + 1)[steps, others]
        return gaps(bodies, there)
    if name == DRIVABLE and world.drivable is not None:
        off = _off_road_m((*world.drivable, *(world.intersections or ())), bodies)
        return None if off is None else off.max(axis=1)
    if name == LANE_KEEPING and world.centreline is not None:
        return on_line(np.stack([bodies.x, bodies.y], axis=-1), world.centreline).beside_m
    return None if failures.by_m is None else failures.by_m[plans]


def _off_road_m(areas: Sequence[Area], bodies: Boxes) -> Array | None:
    """How far each corner of ``bodies`` [m] is off the road, [m, 4]; None where there is no road at all."""
    if not areas:
        return None
    corners = bodies.corners().reshape(-1, 2)
    edges = np.concatenate([area.edges for area in areas])
    off = np.where(Points(corners).inside_any(areas), 0.0, to_edges(corners, edges))
    return off.reshape(-1, 4)


Side = Literal["left", "right"]
_FULL: Final = 1.0 - 1e-9
_UNITS: Final = {
    "longitudinal_acceleration": "mps2",
    "lateral_acceleration": "mps2",
    "jerk": "mps3",
    "longitudinal_jerk": "mps3",
    "yaw_acceleration": "rad_s2",
    "yaw_rate": "rad_s",
    "acceleration_change": "mps2",
    "jerk_change": "mps3",
    "yaw_rate_change": "rad_s",
    "yaw_acceleration_change": "rad_s2",
}
_NO_OTHERS: Final = Others()


@dataclass(frozen=True)
class Measure:
    """By how much: a value whose name ends in its unit, and the limit that it passes, where there is one."""

    name: str
    value: float
    limit: float | None = None

    @property
    def beyond(self) -> float | None:
        """How far the value is from the limit."""
        return None if self.limit is None else abs(self.value - self.limit)


@dataclass(frozen=True)
class Other:
    """With whom a plan fails; None where it is not there, or has no place.

    Attributes:
        other_id: of the track or the light.
        kind: what it is, such as ``vehicle``.
        now_ahead_m, now_left_m: its centre, seen from the ego's centre and heading now.
        ahead_m, left_m: the same when the plan fails.
        gap_m: between the boxes then.
        closing_mps: by how much the two come closer each second then; negative where they part.
        speed_mps: its own then.
    """

    other_id: str
    kind: str
    now_ahead_m: float | None = None
    now_left_m: float | None = None
    ahead_m: float | None = None
    left_m: float | None = None
    gap_m: float | None = None
    closing_mps: float | None = None
    speed_mps: float | None = None


@dataclass(frozen=True)
class Fact:
    """One sub-score of a plan below its full value.

    Attributes:
        sub_score, value: which, and what it is.
        time_s: when the plan fails first; None where the plan is judged as a whole.
        other: with whom; None where nobody is involved.
        side: on which side of the ego it leaves the road, or goes beside the centre line; None elsewhere.
        measures: by how much.
    """

    sub_score: str
    value: float
    time_s: float | None
    other: Other | None
    side: Side | None
    measures: tuple[Measure, ...]

    def measure(self, name: str) -> Measure | None:
        """The measure of that name, where there is one."""
        return next((each for each in self.measures if each.name == name), None)


def facts_of(world: World, scores: Scores, others: Others = _NO_OTHERS) -> list[tuple[Fact, ...]]:
    """What each plan fails at, in the order of time; what is judged as a whole comes last.

    Args:
        world, scores: as `looktwice.model.driving.pdm.scoring.score` took and gave them.
        others: what the plans were compared with; extended comfort is told only with the plan before.
    """
    ego = ego_boxes(world, scores.states)
    found = []
    for plan in range(len(scores.score)):
        case = _ScoredPlan(world, scores, others, plan, ego[plan])
        facts = [
            case.fact(name, float(values[plan]))
            for name, values in scores.sub_scores.items()
            if values is not None and values[plan] < _FULL
        ]
        found.append(tuple(sorted(facts, key=lambda fact: np.inf if fact.time_s is None else fact.time_s)))
    return found


@dataclass(frozen=True, eq=False)
class _ScoredPlan:
    """One plan in its world."""

    world: World
    scores: Scores
    others: Others
    plan: int
    ego: Boxes

    def fact(self, name: str, value: float) -> Fact:
        failures = self.scores.failures.get(name)
        step = -1 if failures is None else int(failures.step[self.plan])
        place = -1 if failures is None else int(failures.other[self.plan])
        time_s = None if step < 0 else round(step * STEP_S, 1)
        if name == LIGHTS and self.world.lights and place >= 0:
            other = Other(self.world.lights[place].light_id, "red light")
            return Fact(name, value, time_s, other, None, ())
        if name in (COLLISIONS, TIME_TO_COLLISION) and self.world.tracks and place >= 0:
            track = self.world.tracks[place]
            ahead = self._look_ahead(track, step) if name == TIME_TO_COLLISION else None
            measures = () if ahead is None else (
                Measure("time_to_collision_s", round(ahead * STEP_S, 1), LOOK_AHEAD[-1] * STEP_S),
            )  # fmt: skip
            return Fact(name, value, time_s, self._other(track, step, ahead or 0), None, measures)
        if name == DRIVABLE:
            return self._off_road(name, value, time_s, step)
        if name == LANE_KEEPING and step >= 0:
            return self._beside(name, value, time_s, step)
        return Fact(name, value, time_s, None, None, tuple(self._by_how_much(name)))

    def _by_how_much(self, name: str) -> Iterator[Measure]:
        states, version = self.scores.states[self.plan][None], self.scores.version
        if name == PROGRESS and self.scores.progress_m is not None and self.scores.reference_m is not None:
            progress, reference = float(self.scores.progress_m[self.plan]), self.scores.reference_m
            if progress >= reference:
                # Nothing is missing: the plan has no progress to its credit since it fails at a factor.
                yield Measure("progress_m", progress)
                return
            yield Measure("progress_m", progress, reference)
            yield Measure("missing_share", 1.0 - progress / reference)
        elif name == DIRECTION and (by_m := self.scores.failures[name].by_m) is not None:
            yield Measure("against_traffic_m", float(by_m[self.plan]), DIRECTION_FINE_M)
        elif name == COMFORT:
            past = self.world.past if version == "v2.2" else None
            yield from map(_measure, excesses(states, self.world.vehicle, version, past))
        elif name == EXTENDED_COMFORT and self.others.previous is not None:
            found = extended_excesses(states, self.others.previous, self.others.previous_age_s)
            yield from map(_measure, found)

    def _other(self, track: TrackedBox, step: int, ahead: int) -> Other:
        """``track`` when the plan fails; or ``ahead`` steps later, where it is not there yet."""
        kind = track.kind or ("road user" if track.is_agent else "obstacle")
        poses = track.poses
        then = self._seen(poses[step], step)
        now_ahead_m, now_left_m = self._seen(poses[0], 0) or (None, None)
        ahead_m, left_m = then or self._seen(poses[step + ahead], step) or (None, None)
        found = Other(track.track_id, kind, now_ahead_m, now_left_m, ahead_m, left_m)
        if then is None:
            return found
        box = track_boxes((track,), step + 1)[step, [0]]
        found = replace(found, gap_m=float(gaps(self.ego[[step]], box)[0]))
        moves = np.diff(poses[max(step - 1, 0) : step + 2, :2], axis=0) / STEP_S
        moves = moves[np.isfinite(moves).all(axis=1)]
        if not len(moves):
            return found
        velocity = moves.mean(axis=0)
        apart = poses[step, :2] - np.array([self.ego.x[step], self.ego.y[step]])
        distance = max(float(np.hypot(*apart)), 1e-9)
        own = self.scores.states[self.plan, step, SPEED] * np.array([self.ego.cos[step], self.ego.sin[step]])
        closing = float((own - velocity) @ apart / distance)
        return replace(found, closing_mps=closing, speed_mps=float(np.hypot(*velocity)))

    def _seen(self, pose: Array, step: int) -> tuple[float, float] | None:
        """Metres ahead and to the left of the ego's box at ``step``; None of a track that is absent."""
        if not np.isfinite(pose).all():
            return None
        x, y = float(pose[0] - self.ego.x[step]), float(pose[1] - self.ego.y[step])
        cos, sin = float(self.ego.cos[step]), float(self.ego.sin[step])
        return x * cos + y * sin, y * cos - x * sin

    def _look_ahead(self, track: TrackedBox, step: int) -> int | None:
        """The first of the steps ahead at which going straight on from ``step`` would hit ``track``."""
        state = self.scores.states[self.plan, step]
        speed = float(np.hypot(state[SPEED], state[SPEED_Y]))
        boxes = track_boxes((track,), min(step + LOOK_AHEAD[-1] + 1, len(track.poses)))
        for ahead in LOOK_AHEAD:
            shift, body = speed * ahead * STEP_S, self.ego[[step]]
            moved = replace(body, x=body.x + body.cos * shift, y=body.y + body.sin * shift)
            if step + ahead < len(boxes.x) and boxes_meet(moved, boxes[step + ahead, [0]])[0]:
                return ahead
        return None

    def _off_road(self, name: str, value: float, time_s: float | None, step: int) -> Fact:
        areas = (*(self.world.drivable or ()), *(self.world.intersections or ()))
        metres = _off_road_m(areas, self.ego)
        if metres is None or step < 0:
            return Fact(name, value, time_s, None, None, ())
        worst = metres.max(axis=1)
        # Of a box's corners the first two lie on its left.
        side: Side = "left" if int(metres[worst.argmax()].argmax()) < 2 else "right"
        measures = (Measure("off_road_m", float(worst[step])), Measure("most_off_road_m", float(worst.max())))
        return Fact(name, value, time_s, None, side, measures)

    def _beside(self, name: str, value: float, time_s: float | None, step: int) -> Fact:
        line = self.world.centreline
        assert line is not None
        centre = np.array([[self.ego.x[step], self.ego.y[step]]])
        line = line[np.append(True, np.diff(line, axis=0).any(axis=1))]  # points that repeat have no side
        _, (beside_m,), (near,) = on_line(centre, line)
        (x, y), (along, up) = line[near], line[near + 1] - line[near]
        side: Side = "left" if along * (centre[0, 1] - y) - up * (centre[0, 0] - x) > 0 else "right"
        return Fact(
            name, value, time_s, None, side, (Measure("beside_line_m", float(beside_m), LANE_OFFSET_M),)
        )


def _measure(excess: Excess) -> Measure:
    return Measure(f"{excess.bound}_{_UNITS[excess.bound]}", excess.value, excess.limit)
