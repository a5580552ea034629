"""Why plans fail: at which sub-score, when, with whom, and by how much."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.driving.pdm.collisions import track_boxes
from model.driving.pdm.geometry import Boxes, IndexArray, Points, gaps, on_line, to_edges
from model.driving.pdm.scoring import (
    COLLISIONS,
    DRIVABLE,
    LANE_KEEPING,
    LIGHTS,
    TIME_TO_COLLISION,
    Failures,
    Scores,
    ego_boxes,
)
from model.driving.pdm.world import STEP_S, STEPS, Array, World


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
        areas = (*world.drivable, *(world.intersections or ()))
        corners = bodies.corners().reshape(-1, 2)
        edges = np.concatenate([area.edges for area in areas]) if areas else np.zeros((0, 4))
        if not len(edges):
            return None
        off = np.where(Points(corners).inside_any(areas), 0.0, to_edges(corners, edges))
        farthest: Array = off.reshape(-1, 4).max(axis=1)
        return farthest
    if name == LANE_KEEPING and world.centreline is not None:
        return on_line(np.stack([bodies.x, bodies.y], axis=-1), world.centreline)[1]
    return None if failures.by_m is None else failures.by_m[plans]
