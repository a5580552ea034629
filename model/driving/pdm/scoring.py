"""PDMS v1.1 and EPDMS v2.2 of many plans in one world.

Source: NAVSIM's scorer (github.com/autonomousvision/navsim), tags v1.1 and v2.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from typing import Final

import numpy as np

from looktwice.model.driving.pdm.collisions import at_fault, too_close, track_boxes
from looktwice.model.driving.pdm.comfort import Version, comfort, extended_comfort
from looktwice.model.driving.pdm.geometry import Boxes, IndexArray
from looktwice.model.driving.pdm.lanes import (
    DIRECTION_FINE_M,
    areas_of,
    direction_scores,
    driven_against,
    lane_losses,
    progress_m,
    red_light_steps,
)
from looktwice.model.driving.pdm.plan_simulator import reference_poses, simulate
from looktwice.model.driving.pdm.world import (
    HEADING,
    LONG_STEPS,
    SPEED,
    SPEED_Y,
    STEPS,
    Array,
    BoolArray,
    ScoreError,
    World,
)

COLLISIONS: Final = "no_at_fault_collisions"
DRIVABLE: Final = "drivable_area_compliance"
DIRECTION: Final = "driving_direction_compliance"
LIGHTS: Final = "traffic_light_compliance"
PROGRESS: Final = "ego_progress"
TIME_TO_COLLISION: Final = "time_to_collision"
LANE_KEEPING: Final = "lane_keeping"
COMFORT: Final = "comfort"
EXTENDED_COMFORT: Final = "extended_comfort"

FACTORS: Final[Mapping[Version, tuple[str, ...]]] = {
    "v1.1": (COLLISIONS, DRIVABLE),
    "v2.2": (COLLISIONS, DRIVABLE, DIRECTION, LIGHTS),
}
"""Sub-scores that are multiplied."""
WEIGHTS: Final[Mapping[Version, Mapping[str, float]]] = {
    "v1.1": {PROGRESS: 5.0, TIME_TO_COLLISION: 5.0, COMFORT: 2.0},
    "v2.2": {PROGRESS: 5.0, TIME_TO_COLLISION: 5.0, LANE_KEEPING: 2.0, COMFORT: 2.0, EXTENDED_COMFORT: 2.0},
}
"""Sub-scores that are averaged, and how much each counts."""
SHORT_PROGRESS_M: Final = 5.0
"""Where no plan gets farther, progress is not judged."""
_TOGETHER: Final = 256
"""Plans scored at a time; more of them leave the processor's cache."""
_LAST_TTC_STEP: Final[Mapping[Version, int]] = {"v1.1": STEPS, "v2.2": STEPS - 9}


@dataclass(frozen=True, eq=False)
class Failures:
    """When and with whom plans fail at one sub-score, [n] each.

    Attributes:
        step: the first failing step; -1 where there is none.
        other: the place of a track or light in its list; -1 where there is none.
        what: which bound is broken, where the sub-score has several; "" otherwise.
        by_m: the most metres driven against the traffic within a second, of driving direction only.
    """

    step: IndexArray
    other: IndexArray
    what: tuple[str, ...] = ()
    by_m: Array | None = None

    def without(self, count: int) -> Failures:
        """Those of the plans after the first ``count``."""
        by_m = None if self.by_m is None else self.by_m[count:]
        return Failures(self.step[count:], self.other[count:], self.what[count:], by_m)


@dataclass(frozen=True, eq=False)
class Scores:
    """What plans are worth.

    Attributes:
        version: whose rules.
        sub_scores: [n] each, or None where a layer or a plan that it needs is missing; NaN for a plan
            whose case the missing layer would decide.
        score: [n]; NaN where a sub-score that counts is missing.
        partial_score: [n], the same of those sub-scores only that are there.
        missing: the sub-scores that are None and would count.
        against: what progress was measured against; None where it was not measured.
        failures: of each sub-score with a time of failure.
        states: [n, 41, 11], simulated.
        progress_m: [n], before it is set in relation; None without a centre line.
        reference_m: the reference's progress times what its factors are; None where it was not measured.
    """

    version: Version
    sub_scores: Mapping[str, Array | None]
    score: Array
    partial_score: Array
    missing: tuple[str, ...]
    against: str | None
    failures: Mapping[str, Failures]
    states: Array
    progress_m: Array | None
    reference_m: float | None = None


@dataclass(frozen=True, eq=False)
class Others:
    """Plans that a plan is compared with.

    Attributes:
        reference: [8, 3] or [64, 3], the plan that progress is measured against.
        against: what the reference is, in a word, such as ``expert``.
        previous: [41, 11], simulated states of the plan made a little earlier, for extended comfort.
        previous_age_s: how much earlier.
        human: [8, 3] or [64, 3]; what the human fails at too, plans are forgiven (v2.2).
    """

    reference: Array | None = None
    against: str = "reference"
    previous: Array | None = None
    previous_age_s: float = 0.5
    human: Array | None = None


_ALONE: Final = Others()


def score(
    world: World, plans: Array, version: Version = "v2.2", others: Others = _ALONE, *, centre: bool = False
) -> Scores:
    """Score plans by NAVSIM's rules.

    Args:
        world: where they drive.
        plans: [n, 8, 3] at 0.5 s or [n, 64, 3] at 0.1 s: x, y, heading in the world's frame.
        version: whose rules.
        others: plans to compare with; those of ``others`` are given as the plans are.
        centre: whether poses are those of the box's centre instead of the rear axle.

    Raises:
        ScoreError: plans of a wrong length or not finite, tracks that end too early.
    """

    besides = [each for each in (others.reference, others.human) if each is not None]
    references = np.concatenate(
        [
            reference_poses(given, world.vehicle, world.ego, centre=centre)
            for given in (*(each[None] for each in besides), plans)
        ]
    )
    return score_states(world, simulate(references, world.vehicle, world.ego), version, others)


def score_states(world: World, states: Array, version: Version, others: Others = _ALONE) -> Scores:
    """Score simulated ``states`` [n, 41, 11].

    Those of the plans of ``others`` come first: the reference's where there is one, then the human's.
    """
    needed = LONG_STEPS if version == "v1.1" else STEPS + 1
    for track in world.tracks or ():
        if len(track.poses) < needed:
            raise ScoreError(
                f"tracks/{track.track_id}",
                f"{version} needs {needed} poses from now on, not {len(track.poses)}",
            )
    parts = [
        _alone(world, states[first : first + _TOGETHER], version)
        for first in range(0, max(len(states), 1), _TOGETHER)
    ]
    every, failures, gained = _joined(parts)
    product = _product(every, version, len(states))
    besides = (others.reference is not None) + (others.human is not None)
    subs = {name: None if value is None else value[besides:] for name, value in every.items()}
    own = states[besides:]
    against, best = None, None
    if others.reference is not None and gained is not None:
        best = float(gained[0] * product[0])
        subs[PROGRESS] = progress_scores(gained[besides:], product[besides:], best, version)
        against, best = (None, None) if np.isnan(best) else (others.against, best)
    if version == "v2.2" and others.previous is not None:
        subs[EXTENDED_COMFORT] = extended_comfort(own, others.previous, others.previous_age_s).astype(float)
    if version == "v2.2" and others.human is not None:
        _forgive(subs, {name: value[besides - 1] for name, value in every.items() if value is not None})
    missing = tuple(name for name in (*FACTORS[version], *WEIGHTS[version]) if subs[name] is None)
    partial = _aggregate(subs, version, len(own))
    there = [value for value in subs.values() if value is not None]
    undecided = np.isnan(there).any(axis=0) if there else np.zeros(len(own), dtype=np.bool_)
    complete = np.where(undecided | bool(missing), np.nan, partial)
    kept = {name: each.without(besides) for name, each in failures.items()}
    metres = None if gained is None else gained[besides:]
    return Scores(version, subs, complete, partial, missing, against, kept, own, metres, best)


def _forgive(subs: dict[str, Array | None], human: Mapping[str, float]) -> None:
    """Set to 1 what the human fails at as well.

    NAVSIM scores the human without a past and against no other plan, so that comfort and progress are never
    among it.
    """
    for name, value in human.items():
        own = subs[name]
        if name not in (COMFORT, PROGRESS) and own is not None and value == 0.0:
            subs[name] = np.ones_like(own)


_Part = tuple[dict[str, Array | None], dict[str, Failures], Array | None]


def _alone(world: World, states: Array, version: Version) -> _Part:
    """The sub-scores that need no other plan, their failures, and the progress in metres."""
    ego = ego_boxes(world, states)
    areas = areas_of(ego, states[..., :2], world)
    speeds = np.hypot(states[..., SPEED], states[..., SPEED_Y])
    names = (*FACTORS[version], *WEIGHTS[version])
    subs: dict[str, Array | None] = dict.fromkeys(dict.fromkeys((*names, DIRECTION)), None)
    failures = {}
    if world.tracks is not None:
        last = _LAST_TTC_STEP[version]
        boxes = track_boxes(world.tracks, last + 10)
        hits = at_fault(ego, states, speeds, boxes, world.tracks, areas)
        close = too_close(ego, states, speeds, boxes, len(world.tracks), areas, last)
        subs[COLLISIONS], subs[TIME_TO_COLLISION] = hits.scores, close.scores
        failures[COLLISIONS] = Failures(hits.first_step, hits.track)
        failures[TIME_TO_COLLISION] = Failures(close.first_step, close.track)
    if areas.off_road is not None:
        subs[DRIVABLE] = np.where(areas.off_road.any(axis=1), 0.0, 1.0)
        failures[DRIVABLE] = _since(areas.off_road)
    if areas.off_route is not None and (version == "v1.1" or areas.crossing is not None):
        against = areas.off_route
        if version == "v2.2" and areas.crossing is not None:
            against = against & ~areas.crossing
        metres = driven_against(ego, against)
        subs[DIRECTION] = direction_scores(metres)
        failures[DIRECTION] = replace(_since(metres >= DIRECTION_FINE_M), by_m=metres.max(axis=1))
    if version == "v2.2" and world.lights is not None:
        step, light = red_light_steps(ego, world)
        subs[LIGHTS] = np.where(step < 0, 1.0, 0.0)
        failures[LIGHTS] = Failures(step, light)
    if version == "v2.2" and world.centreline is not None and areas.crossing is not None:
        lost = lane_losses(ego, areas.crossing, world.centreline)
        subs[LANE_KEEPING] = np.where(lost < 0, 1.0, 0.0)
        failures[LANE_KEEPING] = Failures(lost, np.full(len(lost), -1))
    if version == "v1.1" or world.past is not None:
        smooth = comfort(states, world.vehicle, version, world.past if version == "v2.2" else None)
        subs[COMFORT] = smooth.holds.astype(np.float64)
        failures[COMFORT] = Failures(smooth.first_step, np.full(len(states), -1), smooth.bound)
    return subs, failures, None if world.centreline is None else progress_m(ego, world.centreline)


def ego_boxes(world: World, states: Array) -> Boxes:
    """The ego's boxes [n, 41] at ``states``."""
    cos, sin = np.cos(states[..., HEADING]), np.sin(states[..., HEADING])
    vehicle = world.vehicle
    length, width = (np.full(cos.shape, side / 2) for side in (vehicle.length_m, vehicle.width_m))
    x, y = states[..., 0] + vehicle.centre_m * cos, states[..., 1] + vehicle.centre_m * sin
    return Boxes(x, y, cos, sin, length, width)


def progress_scores(gained_m: Array, product: Array, reference: float, version: Version) -> Array:
    """Progress in relation to the reference's, one plan at a time.

    Args:
        gained_m: [n], metres along the centre line.
        product: [n], of the sub-scores that are multiplied.
        reference: the reference's metres times its product; NaN where that is undecided, and so are all.
        version: in v1.1 a plan that fails makes no progress; in v2.2 it keeps its own.
    """
    earned = gained_m * product
    most = np.maximum(earned, reference)
    far = most > SHORT_PROGRESS_M
    scale = np.where(far, most, 1.0)
    if version == "v1.1":
        scores = np.where(far, earned / scale, np.where(product == 0.0, 0.0, 1.0))
    else:
        scores = np.where(far, np.clip(gained_m / scale, 0.0, 1.0), 1.0)
    return np.where(np.isnan(most), np.nan, scores)


def _since(broken: BoolArray) -> Failures:
    step = np.where(broken.any(axis=1), broken.argmax(axis=1), -1)
    return Failures(step, np.full(len(step), -1))


def _product(subs: Mapping[str, Array | None], version: Version, count: int) -> Array:
    """Of the multiplied sub-scores that are there, [count]."""
    there = [value for name in FACTORS[version] if (value := subs[name]) is not None]
    return reduce(np.multiply, there, np.ones(count))


def _aggregate(subs: Mapping[str, Array | None], version: Version, count: int) -> Array:
    """The product times the mean of the others, of what is there; NaN where nothing is."""
    product = _product(subs, version, count)
    total, counted = np.zeros(count), np.zeros(count)
    for name, weight in WEIGHTS[version].items():
        if (value := subs[name]) is not None:
            known = ~np.isnan(value)
            total += np.where(known, value, 0.0) * weight
            counted += known * weight
    some_factor = any(subs[name] is not None for name in FACTORS[version])
    mean = np.where(counted > 0, total / np.where(counted > 0, counted, 1.0), 1.0 if some_factor else np.nan)
    result: Array = product * mean
    return result


def _joined(parts: list[_Part]) -> _Part:
    if len(parts) == 1:
        return parts[0]
    subs, failures, _ = parts[0]

    def together(values: Iterable[Array | None]) -> Array | None:
        there = [value for value in values if value is not None]
        return np.concatenate(there) if there else None

    return (
        {name: together(part[0][name] for part in parts) for name in subs},
        {
            name: Failures(
                np.concatenate([part[1][name].step for part in parts]),
                np.concatenate([part[1][name].other for part in parts]),
                tuple(what for part in parts for what in part[1][name].what),
                together(part[1][name].by_m for part in parts),
            )
            for name in failures
        },
        together(part[2] for part in parts),
    )
