"""Scoring of one request, from the parsed body to the answer; no engine has a part in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np

import looktwice.clients.wire_scores as wire_scores
from looktwice.model.driving.pdm.failures import failures_of
from looktwice.model.driving.pdm.geometry import crosses_itself
from looktwice.model.driving.pdm.labelled import first_speed_mps, plans_of, world_of
from looktwice.model.driving.pdm.plan_simulator import reference_poses, simulate
from looktwice.model.driving.pdm.profiles import SolveError
from looktwice.model.driving.pdm.scoring import Others, Scores, score
from looktwice.model.driving.pdm.world import (
    ACCELERATION,
    ACCELERATION_Y,
    HEADING,
    SPEED,
    STATE_SIZE,
    STEERING,
    STEP_S,
    STEPS,
    YAW_ACCELERATION,
    YAW_RATE,
    Area,
    Array,
    BoolArray,
    EgoVehicle,
    Lane,
    RedLight,
    ScoreError,
    TrackedBox,
    World,
)
from looktwice.service.problems import INVALID_LABELS, INVALID_TRAJECTORY, at
from looktwice.service.scenes.bundled import BundledScenes

_Asked = TypeVar("_Asked")
_Made = TypeVar("_Made")
_DECIMALS: Final = 6
EXPERT: Final = "expert"


@dataclass(frozen=True, eq=False)
class Scored:
    """A request's trajectories with their scores.

    Attributes:
        world, plans, scores, others: as they were scored.
        centre: whether poses are those of the box's centre.
        expert: [64, 3], of a bundled scene; None of a caller's own labels.
    """

    world: World
    plans: Array
    scores: Scores
    others: Others
    centre: bool
    expert: Array | None


def scored(
    asked: wire_scores.ScoreRequest, bundled: BundledScenes, request_id: str
) -> wire_scores.ScoreResponse:
    """The answer to one request.

    Raises:
        ProblemError: labels or trajectories that cannot be scored, an unknown scene.
    """
    found = scores_of(asked, bundled)
    return answer(found.world, found.scores, request_id)


def scores_of(asked: wire_scores.ScoreRequest, bundled: BundledScenes, *, careful: bool = False) -> Scored:
    """The scores of one request, in a ``careful`` world or not; raises as `scored` does."""
    centre = asked.point == "centre"
    against = asked.against
    expert = None
    reference = None if asked.reference is None else trajectory_of(asked.reference, "/reference")
    if asked.labels is not None:
        world = _world(asked.labels, _vehicle(asked.vehicle), centre=centre)
    else:
        labelled = bundled.one(asked.scene_id or "")
        world, centre = world_of(labelled), True
        expert = plans_of(labelled.future)
        if reference is None:
            reference, against = expert, EXPERT
    world = replace(world, careful=careful)
    plans = _trajectories(asked.trajectories)
    others = Others(
        reference,
        against,
        human=None if asked.human is None else trajectory_of(asked.human, "/human"),
    )
    if asked.previous is not None:
        others = replace(
            others,
            previous=_previous(asked.previous, world.vehicle, centre=centre),
            previous_age_s=asked.previous.seconds_ago,
        )
    try:
        found = score(world, plans, asked.version, others, centre=centre)
    except ScoreError as error:
        if error.place.startswith("plans"):
            raise at(INVALID_TRAJECTORY, "/trajectories", error.detail) from None
        raise at(INVALID_LABELS, f"/labels/{error.place}", error.detail) from None
    except SolveError as error:
        raise at(INVALID_TRAJECTORY, "/trajectories", f"cannot be followed: {error}") from None
    return Scored(world, plans, found, others, centre, expert)


def answer(world: World, found: Scores, request_id: str) -> wire_scores.ScoreResponse:
    """Scores as the contract tells them."""
    failures = failures_of(world, found)
    subs = {name: rounded(values, len(found.score)) for name, values in found.sub_scores.items()}
    totals, partial = rounded(found.score, len(found.score)), rounded(found.partial_score, len(found.score))
    progress = rounded(found.progress_m, len(found.score))
    return wire_scores.ScoreResponse(
        request_id=request_id,
        version=found.version,
        missing=list(found.missing),
        against=found.against,
        scores=[
            wire_scores.TrajectoryScore(
                score=totals[row],
                partial_score=partial[row],
                sub_scores={name: values[row] for name, values in subs.items()},
                progress_m=progress[row],
                failures=[
                    wire_scores.ScoreFailure(
                        sub_score=each.sub_score,
                        time_s=each.time_s,
                        other_id=each.other_id,
                        distance_m=None if each.distance_m is None else round(each.distance_m, _DECIMALS),
                        what=each.what,
                    )
                    for each in failures[row]
                ],
            )
            for row in range(len(found.score))
        ],
    )


def rounded(values: Array | None, count: int) -> Sequence[float | None]:
    """Values [n] as they are told: None where they are not known."""
    if values is None:
        return [None] * count
    return [None if math.isnan(value) else round(value, _DECIMALS) for value in values.tolist()]


def _trajectories(asked: list[list[list[float]]]) -> Array:
    for number, each in enumerate(asked):
        _check_length(each, f"/trajectories/{number}")
        if len(each) != len(asked[0]):
            raise at(INVALID_TRAJECTORY, f"/trajectories/{number}", "all have as many poses as the first one")
    return np.array(asked, dtype=np.float64)


def trajectory_of(asked: list[list[float]], pointer: str) -> Array:
    """A trajectory [8, 3] or [64, 3]; raises `ProblemError` at ``pointer`` for one of another length."""
    _check_length(asked, pointer)
    return np.array(asked, dtype=np.float64)


def _check_length(asked: list[list[float]], pointer: str) -> None:
    if len(asked) not in (8, 64):
        raise at(INVALID_TRAJECTORY, pointer, f"has {len(asked)} poses; 8 at 0.5 s or 64 at 0.1 s are scored")


def _vehicle(asked: wire_scores.VehicleShape) -> EgoVehicle:
    try:
        return EgoVehicle(**asked.model_dump())
    except ScoreError as error:
        raise at(INVALID_LABELS, "/vehicle", error.detail) from None


def _ego(asked: wire_scores.EgoMotion, vehicle: EgoVehicle, *, centre: bool) -> Array:
    state = np.zeros(STATE_SIZE)
    state[0] = -vehicle.centre_m if centre else 0.0
    state[SPEED], state[ACCELERATION] = asked.speed_mps, asked.acceleration_mps2
    state[STEERING], state[YAW_RATE] = asked.steering_rad, asked.yaw_rate_rad_s
    state[YAW_ACCELERATION] = asked.yaw_acceleration_rad_s2
    return state


def _previous(asked: wire_scores.PreviousPlan, vehicle: EgoVehicle, *, centre: bool) -> Array:
    pointer = "/previous/trajectory"
    plan, ego = trajectory_of(asked.trajectory, pointer), _ego(asked.ego, vehicle, centre=centre)
    try:
        states: Array = simulate(reference_poses(plan[None], vehicle, ego, centre=centre), vehicle, ego)[0]
    except (ScoreError, SolveError) as error:
        raise at(INVALID_TRAJECTORY, pointer, str(error)) from None
    return states


def _world(asked: wire_scores.Labels, vehicle: EgoVehicle, *, centre: bool) -> World:
    past = None
    if asked.past is not None:
        past = np.zeros((len(asked.past), STATE_SIZE))
        for row, each in enumerate(asked.past):
            past[row, HEADING] = each.heading_rad
            past[row, ACCELERATION] = each.acceleration_mps2
            past[row, ACCELERATION_Y] = each.lateral_acceleration_mps2
    place = "/labels"
    try:
        return World(
            _ego(asked.ego, vehicle, centre=centre),
            vehicle,
            tracks=_layer(asked.agents, f"{place}/agents", _track),
            lanes=_layer(asked.lanes, f"{place}/lanes", _lane),
            intersections=_layer(asked.intersections, f"{place}/intersections", _outline),
            drivable=_layer(asked.drivable, f"{place}/drivable", _area),
            lights=_layer(asked.red_lights, f"{place}/red_lights", _light),
            centreline=None if asked.centreline is None else np.array(asked.centreline, dtype=np.float64),
            past=past,
        )
    except ScoreError as error:
        raise at(INVALID_LABELS, f"{place}/{error.place}", error.detail) from None


def _layer(
    given: Sequence[_Asked] | None, pointer: str, make: Callable[[_Asked, str], _Made]
) -> tuple[_Made, ...] | None:
    if given is None:
        return None
    made = []
    for number, each in enumerate(given):
        try:
            made.append(make(each, f"{pointer}/{number}"))
        except ScoreError as error:
            raise at(INVALID_LABELS, f"{pointer}/{number}", error.detail) from None
    return tuple(made)


def _lane(asked: wire_scores.ScoredLane, pointer: str) -> Lane:
    return Lane(asked.lane_id, _outline(asked.ring, f"{pointer}/ring"), asked.on_route)


def _light(asked: wire_scores.ClosedLane, pointer: str) -> RedLight:
    return RedLight(
        asked.light_id, _outline(asked.ring, f"{pointer}/ring"), _red(asked.from_s, asked.until_s)
    )


def _outline(ring: list[list[float]], pointer: str) -> Area:
    return _area([ring], pointer)


def _red(from_s: float, until_s: float) -> BoolArray:
    at_s = np.arange(STEPS + 1) * STEP_S
    red: BoolArray = (at_s >= from_s - 1e-9) & (at_s <= until_s + 1e-9)
    return red


def _area(rings: list[list[list[float]]], pointer: str) -> Area:
    try:
        area = Area(tuple(np.array(ring, dtype=np.float64) for ring in rings))
    except ScoreError as error:
        raise at(INVALID_LABELS, pointer, error.detail) from None
    for ring in area.rings:
        if crosses_itself(ring):
            raise at(INVALID_LABELS, pointer, "crosses itself; give its points in the order of its outline")
    return area


def _track(asked: wire_scores.ScoredAgent, pointer: str) -> TrackedBox:
    poses = np.array([[np.nan] * 3 if row is None else row for row in asked.poses], dtype=np.float64)
    if not np.isfinite(poses).any():
        raise at(INVALID_LABELS, f"{pointer}/poses", "has no future: none of its poses is there")
    speed = first_speed_mps(poses) if asked.speed_mps is None else asked.speed_mps
    return TrackedBox(
        asked.agent_id, asked.kind != "static", asked.length_m, asked.width_m, poses, speed, asked.kind
    )
