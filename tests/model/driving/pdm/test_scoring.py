"""What a score says where something is missing, and what does not change it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from looktwice.model.driving.pdm.comfort import Version
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
    Others,
    score,
)
from looktwice.model.driving.pdm.world import (
    Area,
    Array,
    EgoVehicle,
    Lane,
    RedLight,
    ScoreError,
    TrackedBox,
    World,
)
from tests.model.driving.pdm.worlds import case


def box(x: float, y: float, length: float, width: float) -> Area:
    return Area((np.array([[x, y], [x + length, y], [x + length, y + width], [x, y + width]]),))


def standing(name: str, x: float, y: float = 0.0, *, agent: bool = True) -> TrackedBox:
    return TrackedBox(name, agent, 4.5, 1.9, np.tile([x, y, 0.0], (51, 1)), 0.0)


def straight(speed: float, left: float = 0.0) -> Array:
    t = np.arange(1, 9) * 0.5
    return np.stack([speed * t, left * np.clip(t / 2, 0, 1), 0 * t], axis=-1)


def road(**layers: Any) -> World:
    """Two lanes along x, of which the right one is the ego's."""
    ego = np.zeros(11)
    ego[3] = 8.0
    past = np.zeros((15, 11))
    past[:, 3] = 8.0
    everything: dict[str, Any] = {
        "tracks": (),
        "lanes": (Lane("mine", box(-20, -2, 120, 4), True), Lane("other", box(-20, 2, 120, 4), False)),
        "intersections": (),
        "drivable": (box(-20, -2, 120, 8),),
        "lights": (),
        "centreline": np.stack([np.arange(-20.0, 100.0), np.zeros(120)], axis=-1),
        "past": past,
    }
    return World(ego, **(everything | layers))


def test_a_good_plan_is_worth_1_and_says_what_it_was_measured_against() -> None:
    found = score(road(), straight(8)[None], "v1.1", Others(reference=straight(8), against="expert"))
    assert found.score == pytest.approx([1.0])
    assert (found.against, found.missing) == ("expert", ())


@pytest.mark.parametrize(
    ("layer", "lost"),
    [
        ("tracks", {COLLISIONS, TIME_TO_COLLISION}),
        ("lanes", {DIRECTION}),
        ("drivable", {DRIVABLE}),
        ("lights", {LIGHTS}),
        ("centreline", {PROGRESS, LANE_KEEPING}),
        ("intersections", {DIRECTION, LANE_KEEPING}),
        ("past", {COMFORT}),
    ],
)
def test_a_missing_layer_is_never_a_silent_1(layer: str, lost: set[str]) -> None:
    previous = score(road(), straight(8)[None]).states[0]
    whole = Others(reference=straight(8), previous=previous)
    assert score(road(), straight(8)[None], "v2.2", whole).score == pytest.approx([1.0])
    found = score(road(**{layer: None}), straight(8)[None], "v2.2", whole)
    assert {name for name, value in found.sub_scores.items() if value is None} == lost
    assert set(found.missing) == lost
    assert np.isnan(found.score).all()
    assert found.partial_score == pytest.approx([1.0])


def test_what_is_known_to_be_empty_is_judged() -> None:
    found = score(road(lanes=(), drivable=()), straight(8)[None]).sub_scores
    for name, expected in ((DRIVABLE, 0.0), (DIRECTION, 0.0), (COLLISIONS, 1.0)):
        value = found[name]
        assert value is not None
        assert value.tolist() == [expected]


def test_without_other_plans_progress_and_extended_comfort_are_missing() -> None:
    found = score(road(), straight(8)[None])
    assert set(found.missing) == {PROGRESS, EXTENDED_COMFORT}
    assert found.against is None
    assert np.isnan(found.score).all()


def test_what_a_missing_layer_would_decide_is_left_open_for_that_plan_only() -> None:
    beside = TrackedBox(
        "beside", True, 4.5, 1.9, np.stack([np.arange(51) * 0.8, np.full(51, 4.0), np.zeros(51)], -1), 8.0
    )
    plans = np.stack([straight(8, 3.5), straight(8, -0.5)])
    known = score(road(tracks=(beside,)), plans).sub_scores[COLLISIONS]
    assert known is not None
    assert known.tolist() == [0.0, 1.0]
    unknown = score(road(tracks=(beside,), lanes=None), plans).sub_scores[COLLISIONS]
    assert unknown is not None
    assert np.isnan(unknown[0])
    assert unknown[1] == 1.0


@pytest.mark.parametrize("version", ["v1.1", "v2.2"])
def test_against_a_reference_that_is_left_open_nobody_makes_progress(version: Version) -> None:
    beside = TrackedBox(
        "beside", True, 4.5, 1.9, np.stack([np.arange(51) * 0.8, np.full(51, 4.0), np.zeros(51)], -1), 8.0
    )
    plans, others = np.stack([straight(8, -0.5), straight(1, -0.5)]), Others(straight(8, 3.5), "expert")
    found = score(road(tracks=(beside,), lanes=None), plans, version, others)
    progress = found.sub_scores[PROGRESS]
    assert progress is not None
    assert np.isnan(progress).all()
    assert (found.against, found.reference_m) == (None, None)
    decided = score(road(tracks=(beside,), lanes=None, careful=True), plans, version, others)
    assert not np.isnan(decided.partial_score).any()


@pytest.mark.parametrize("missing", [{"lanes": None}, {"drivable": None}])
def test_a_careful_world_leaves_no_collision_open(missing: dict[str, None]) -> None:
    beside = TrackedBox(
        "beside", True, 4.5, 1.9, np.stack([np.arange(51) * 0.8, np.full(51, 4.0), np.zeros(51)], -1), 8.0
    )
    plan = straight(8, 3.5)[None]
    open_, careful = (
        score(road(tracks=(beside,), careful=each, **missing), plan).sub_scores[COLLISIONS]
        for each in (False, True)
    )
    assert open_ is not None
    assert careful is not None
    assert careful.tolist() == [0.0]
    assert np.isnan(open_).all() or open_.tolist() == [0.0]


def test_failures_tell_when_and_with_whom() -> None:
    world = road(tracks=(standing("far", 60), standing("near", 25), standing("cone", 18, agent=False)))
    found = score(world, np.stack([straight(8), straight(0.0)]))
    collisions = found.sub_scores[COLLISIONS]
    assert collisions is not None
    assert collisions.tolist() == [0.0, 1.0]
    failures = found.failures[COLLISIONS]
    assert failures.other.tolist() == [2, -1]
    # The cone's box begins at 15.75 m, the ego's front is 4.05 m ahead of the axle, at 8 m/s.
    assert failures.step[0] == pytest.approx((15.75 - 4.05) / 0.8, abs=1.5)
    assert failures.step[1] == -1


def test_a_red_light_closes_its_lane_while_it_is_red() -> None:
    lane = box(20, -2, 15, 4)
    late = np.arange(41) >= 35
    for red, expected in ((None, 0.0), (~late, 0.0), (np.arange(41) < 10, 1.0)):
        found = score(road(lights=(RedLight("a", lane, red),)), straight(8)[None]).sub_scores[LIGHTS]
        assert found is not None
        assert found.tolist() == [expected]


@pytest.mark.parametrize("version", ["v1.1", "v2.2"])
def test_a_batch_is_scored_as_its_plans_are_one_by_one(version: Version) -> None:
    drawn = case(5)
    many = np.concatenate([drawn.plans] * 130)
    together = score(drawn.world, many, version, Others(reference=drawn.reference))
    alone = [
        score(drawn.world, plan[None], version, Others(reference=drawn.reference)) for plan in drawn.plans
    ]
    for name, values in together.sub_scores.items():
        expected = [each.sub_scores[name] for each in alone]
        if values is None:
            assert expected == [None] * 5
        else:
            assert values == pytest.approx(np.tile(np.concatenate(expected), 130))  # type: ignore[arg-type]
    assert together.failures[COLLISIONS].step.tolist() == (
        [int(each.failures[COLLISIONS].step[0]) for each in alone] * 130
    )


@pytest.mark.parametrize("seed", range(0, 40, 4))
def test_where_the_world_lies_does_not_matter(seed: int) -> None:
    drawn = case(seed)
    turn, by = 1.1, np.array([30.0, -12.0])

    def moved(points: Array) -> Array:
        cos, sin = np.cos(turn), np.sin(turn)
        result = points.copy()
        result[..., :2] = points[..., :2] @ np.array([[cos, sin], [-sin, cos]]) + by
        if points.shape[-1] > 2:
            result[..., 2] += turn
        return result

    def area(given: Area) -> Area:
        return Area(tuple(moved(ring) for ring in given.rings))

    world = drawn.world
    assert world.lanes is not None
    assert world.drivable is not None
    elsewhere = replace(
        world,
        ego=moved(world.ego),
        tracks=tuple(replace(track, poses=moved(track.poses)) for track in world.tracks or ()),
        lanes=tuple(replace(lane, area=area(lane.area)) for lane in world.lanes),
        intersections=tuple(map(area, world.intersections or ())),
        drivable=tuple(map(area, world.drivable)),
        lights=tuple(replace(light, area=area(light.area)) for light in world.lights or ()),
        centreline=moved(world.centreline if world.centreline is not None else np.zeros((2, 2))),
        past=None if world.past is None else moved(world.past),
    )
    here = score(world, drawn.plans, "v2.2", Others(reference=drawn.reference))
    there = score(elsewhere, moved(drawn.plans), "v2.2", Others(reference=moved(drawn.reference)))
    for name, values in here.sub_scores.items():
        assert there.sub_scores[name] == (None if values is None else pytest.approx(values, abs=1e-6))


def test_poses_of_the_centre_are_those_of_the_axle_moved() -> None:
    world = road(tracks=(standing("ahead", 30, 1.0),))
    axle = np.stack([straight(8, 2.0), straight(5)])
    centre = axle.copy()
    centre[..., 0] += world.vehicle.centre_m * np.cos(axle[..., 2])
    centre[..., 1] += world.vehicle.centre_m * np.sin(axle[..., 2])
    one = score(world, axle, "v2.2", Others(reference=axle[0]))
    other = score(world, centre, "v2.2", Others(reference=centre[0]), centre=True)
    assert other.states == pytest.approx(one.states)
    assert other.partial_score == pytest.approx(one.partial_score)


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (lambda: score(road(), straight(8)[None, :7]), "8 poses at 0.5 s or 64"),
        (lambda: score(road(), np.full((1, 8, 3), np.nan)), "plans/0.*not finite"),
        (lambda: standing("x", float("inf")), "a pose is three finite numbers"),
        (lambda: TrackedBox("x", True, 4, 2, np.full((51, 3), np.nan), 0.0), "no future"),
        (lambda: Area((np.zeros((2, 2)),)), "three different points"),
        (lambda: EgoVehicle(0.0, 1.0, 1.0, 1.0), "1 mm"),
        (lambda: road(tracks=(standing("a", 9), standing("a", 9))), "occur twice: a"),
        (lambda: road(centreline=np.zeros((3, 2))), "all its points are the same"),
        (
            lambda: score(
                road(tracks=(replace(standing("a", 9), poses=np.zeros((41, 3))),)), straight(8)[None], "v1.1"
            ),
            "v1.1 needs 50 poses",
        ),
        (
            lambda: score(
                road(), straight(8)[None], "v2.2", Others(previous=np.zeros((41, 11)), previous_age_s=0.6)
            ),
            "0.55",
        ),
    ],
)
def test_what_cannot_be_scored_is_refused(made: Any, text: str) -> None:
    with pytest.raises(ScoreError, match=text):
        made()
