"""Facts of failed plans: what, when, with whom, by how much; and what the built-in teacher makes of them."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.course import course_of
from looktwice.model.driving.pdm.failures import Fact, facts_of
from looktwice.model.driving.pdm.feedback import Feedback, parse_feedback
from looktwice.model.driving.pdm.judged import Measurement, foreign_numbers, numbers
from looktwice.model.driving.pdm.judging import PlanExplanation, judged_plans
from looktwice.model.driving.pdm.rule_teacher import SHORT, rule_sections
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
    ego_boxes,
    score,
)
from looktwice.model.driving.pdm.world import PACIFICA, Array, RedLight, ScoreError, World
from tests.model.driving.pdm.test_scoring import box, road, standing, straight
from tests.model.driving.pdm.worlds import case


def facts(world: World, plan: Array, version: Version = "v2.2", others: Others = Others()) -> dict[str, Fact]:
    (found,) = facts_of(world, score(world, plan[None], version, others), others)
    return {fact.sub_score: fact for fact in found}


def test_a_good_plan_has_no_facts() -> None:
    assert facts(road(), straight(8), others=Others(reference=straight(8))) == {}


def test_a_collision_tells_when_with_whom_and_how_fast() -> None:
    leader = replace(standing("leader", 20.0, 1.0), kind="vehicle")
    found = facts(road(tracks=(leader,)), straight(8))
    hit, close = found[COLLISIONS], found[TIME_TO_COLLISION]
    # Bumper to bumper: the leader's rear is at 17.75 m, the ego's front 4.05 m ahead of its axle.
    assert hit.time_s is not None
    assert hit.time_s == pytest.approx((17.75 - 4.049) / 8, abs=0.15)
    assert hit.other is not None
    assert (hit.other.other_id, hit.other.kind, hit.other.gap_m) == ("leader", "vehicle", 0.0)
    assert (hit.other.now_ahead_m, hit.other.now_left_m) == pytest.approx((20.0 - PACIFICA.centre_m, 1.0))
    assert hit.other.speed_mps == pytest.approx(0.0)
    assert hit.other.closing_mps == pytest.approx(8.0, abs=0.3)
    assert close.time_s is not None
    assert close.time_s < hit.time_s
    assert close.other is not None
    assert close.other.gap_m is not None
    assert close.other.gap_m > 0
    (left,) = close.measures
    assert left.name == "time_to_collision_s"
    assert left.limit == pytest.approx(0.9)
    # At 8 m/s the gap is gone after so many seconds: looked at in steps of 0.3 s.
    assert left.value - 0.31 < close.other.gap_m / 8 <= left.value


def test_one_that_appears_later_has_no_place_now() -> None:
    late = standing("late", 14.0)
    late.poses[:10] = np.nan
    hit = facts(road(tracks=(late,)), straight(8))[COLLISIONS]
    assert hit.other is not None
    assert hit.other.now_ahead_m is None
    assert hit.other.ahead_m is not None


def test_metres_off_the_road_and_the_side() -> None:
    out = facts(road(), straight(8, left=7.0))[DRIVABLE]
    most = out.measure("most_off_road_m")
    assert most is not None
    # The road ends 6 m to the left.
    body = ego_boxes(road(), score(road(), straight(8, left=7.0)[None]).states).corners()
    assert most.value == pytest.approx(body[..., 1].max() - 6.0)
    assert out.side == "left"
    first = out.measure("off_road_m")
    assert first is not None
    assert 0 < first.value < most.value
    assert facts(road(), straight(8, left=-3.0))[DRIVABLE].side == "right"


def test_missing_progress_is_a_share_of_the_references() -> None:
    slow = facts(road(), straight(6), others=Others(reference=straight(8)))[PROGRESS]
    progress, missing = slow.measure("progress_m"), slow.measure("missing_share")
    assert progress is not None
    assert progress.limit is not None
    assert missing is not None
    assert missing.value == pytest.approx(1 - progress.value / progress.limit)
    assert missing.value == pytest.approx(1 - slow.value)
    # Who fails at a factor has no progress to its credit, and none is said to be missing.
    wild = facts(road(), straight(8, left=7.0), "v1.1", Others(reference=straight(6)))[PROGRESS]
    assert (wild.value, [each.name for each in wild.measures]) == (0.0, ["progress_m"])


def test_a_rough_ride_names_every_broken_bound_and_by_how_much() -> None:
    stop = straight(0.0)
    rough = facts(road(), stop)[COMFORT]
    named = {each.name: each for each in rough.measures}
    assert named["longitudinal_acceleration_mps2"].limit == pytest.approx(-4.05)
    assert named["longitudinal_acceleration_mps2"].value < -4.05
    beyond = named["longitudinal_acceleration_mps2"].beyond
    assert beyond == pytest.approx(-4.05 - named["longitudinal_acceleration_mps2"].value)


def test_another_plan_than_before_a_red_light_and_the_other_lane_are_facts() -> None:
    ahead = RedLight("signal", box(20, -2, 20, 4))
    calm = score(road(), straight(8)[None]).states[0]
    found = facts(road(lights=(ahead,)), straight(8, left=4.0), others=Others(previous=calm))
    light = found[LIGHTS].other
    assert light is not None
    assert (light.other_id, light.kind, light.gap_m) == ("signal", "red light", None)
    against = found[DIRECTION].measure("against_traffic_m")
    assert against is not None
    assert against.limit is not None
    assert against.value > against.limit
    assert found[EXTENDED_COMFORT].time_s is None
    assert all(each.value > (each.limit or 0) for each in found[EXTENDED_COMFORT].measures)
    beside = found[LANE_KEEPING].measure("beside_line_m")
    assert beside is not None
    assert beside.value > 0.5
    assert found[LANE_KEEPING].side == "left"


@pytest.mark.parametrize("corners_only", [True, False])
def test_a_line_may_be_told_by_its_corners(corners_only: bool) -> None:
    """The nearest stretch of it is a long one, and the middle of a short one is nearer than its middle."""
    along = np.array([-20.0, 45.0]) if corners_only else np.arange(-20.0, 46.0)
    up = np.array([10.0, 20.0]) if corners_only else np.arange(1.0, 21.0)
    line = np.concatenate([np.stack([along, 0 * along], 1), np.stack([0 * up + 45.0, up], 1)])
    found = facts(road(centreline=line, lanes=None), straight(11, left=-2.0))
    assert found[LANE_KEEPING].side == "right"


def test_what_the_human_fails_at_too_is_no_fact() -> None:
    out = straight(8, left=7.0)
    assert DRIVABLE not in facts(road(), out, others=Others(human=out))


@pytest.mark.parametrize("seed", range(24))
def test_facts_are_the_sub_scores_below_1_and_feedback_speaks_of_nothing_else(seed: int) -> None:
    drawn = case(seed)
    others = Others(reference=drawn.reference)
    for version in get_args(Version):
        scores = score(drawn.world, drawn.plans, version, others)
        judged = judged_plans(
            drawn.world, drawn.plans, scores, others, truth=drawn.human if seed % 2 else None
        )
        for row, plan in enumerate(judged):
            lowered = {name for name, value in plan.sub_scores.items() if value is not None and value < 1}
            assert {fact.sub_score for fact in plan.facts} == lowered
            for fact in plan.facts:
                failures = scores.failures.get(fact.sub_score)
                assert (fact.time_s is None) == (failures is None or failures.step[row] < 0)
                if fact.sub_score == COMFORT:
                    assert any(
                        each.name.startswith(scores.failures[COMFORT].what[row]) for each in fact.measures
                    )
            told = rule_sections(plan)
            assert parse_feedback(str(told)) == told
            assert foreign_numbers(told, numbers(plan), plan.names) == []
            named = {fact.sub_score for fact in plan.facts}
            assert all(f"{SHORT[name]} is" in told.safety_failure + told.efficiency_failure for name in named)


def judged_leader(think: str | None = None, truth: Array | None = None, words: str | None = None) -> Feedback:
    world = road(tracks=(replace(standing("7", 20.0), kind="vehicle"),))
    scores = score(world, straight(8)[None], "v1.1")
    (plan,) = judged_plans(
        world, straight(8)[None], scores, Others(), said=[PlanExplanation(words, think)], truth=truth
    )
    return rule_sections(plan)


def test_the_think_process_is_held_against_what_fails() -> None:
    assert "No reasoning was given" in judged_leader().think_process
    overlooks = judged_leader("The road is clear, so I keep my speed.").think_process
    assert "overlooks" in overlooks
    assert "18.54 m ahead" in overlooks
    speaks = judged_leader("A car stands ahead, so I brake.")
    assert "does not draw the conclusion" in speaks.think_process
    assert "ask to decelerate, and the trajectory does not" in speaks.meta_action
    # Of several actions that are named the trajectory does one.
    both = judged_leader("A car stands ahead. I keep my speed and brake later.").meta_action
    assert "does not do that" not in both
    assert "Brake before" in speaks.correction


def test_a_plan_in_words_counts_as_far_as_it_is_judged() -> None:
    track = "- longitudinal\n  - 0.0s-{0}s: Keep Speed\n  - {0}s-6.4s: Accelerate\n"
    lie = "- longitudinal\n  - 0.0s-6.4s: Wait\n"
    assert "does not do that" not in judged_leader(words=track.format("4.5")).meta_action
    assert "does not do that" not in judged_leader(words="not of the plan language: brake").meta_action
    assert "ask to stop, and" in judged_leader(words=lie).meta_action


def test_the_meta_action_is_held_against_the_ground_truth() -> None:
    assert "No ground truth" in judged_leader().meta_action
    assert "matches the ground truth" in judged_leader(truth=straight(8)).meta_action
    braking = straight(8) * np.array([0.4, 1, 1])
    assert "to decelerate instead of to maintain speed" in judged_leader(truth=braking).meta_action


def test_names_of_others_cannot_break_the_text() -> None:
    for name in ("a\nb", "</feedback>", "x  y", " ", "**2. Safety failure:** z"):
        world = road(tracks=(standing(name, 20.0),))
        (plan,) = judged_plans(world, straight(8)[None], score(world, straight(8)[None]), Others())
        assert parse_feedback(str(rule_sections(plan))) == rule_sections(plan)


FACTS = (
    Measurement(18.234, "m"),
    Measurement(-6.31, "m"),
    Measurement(4.0, "s"),
    Measurement(0.0, ""),
    Measurement(0.38, "%"),
    Measurement(38.0, "%"),
)


@pytest.mark.parametrize(
    "text",
    [
        "NC=0 at t = 4 s, 18.23 meters ahead and 6.3 m to the right, [18.2,-6.31].",
        "38 % less; see #12 and CIPO-1 after 4.0s, an 18-metre gap.",
        "no number at all in m/s\u00b2.",
    ],
)
def test_facts_may_be_named_rounded_and_with_their_units(text: str) -> None:
    assert foreign_numbers(Feedback(text, *["x"] * 4), FACTS, ["#12"]) == []


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("a car 18.3 m ahead", "18.3 m"),
        ("within 18 s", "18 s"),
        ("at 4 m/s", "4 m/s"),
        ("in 0.2 m", "0.2 m"),
        ("1e3 or 4e0 m", "e3"),
        ("1,018 m", "1,018"),
        ("twenty metres", "twenty"),
        ("4\u00bd m", "\u00bd"),
        ("\u0664 s", "\u0664"),
        ("at x18", "x18"),
        ("#13 brakes", "13"),
        ("4.0.0", ".0"),
    ],
)
def test_other_numbers_are_found_however_they_are_written(text: str, number: str) -> None:
    found = foreign_numbers(Feedback("x", text, *["x"] * 3), FACTS, ["#12"])
    assert number in found, found


def test_a_threshold_lies_between_0_and_1_and_what_equals_it_is_correct() -> None:
    scores = score(road(), straight(8)[None], "v1.1", Others(reference=straight(8)))
    (plan,) = judged_plans(road(), straight(8)[None], scores, Others(), threshold=1.0)
    assert plan.correct
    for wrong in (-0.1, 1.1, float("nan")):
        with pytest.raises(ScoreError, match="threshold"):
            judged_plans(road(), straight(8)[None], scores, Others(), threshold=wrong)
    bare = World(road().ego)
    with pytest.raises(ScoreError, match="cannot be judged"):
        judged_plans(bare, straight(8)[None], score(bare, straight(8)[None]), Others())


def test_courses_in_words() -> None:
    ego = road().ego
    bend = np.arange(1, 9)[:, None] * 0.5 * 8 * 0.01
    turning = np.concatenate([np.sin(bend) / 0.01, (1 - np.cos(bend)) / 0.01, bend], axis=1)
    told = {
        name: (course.longitudinal, course.lateral)
        for name, plan in {
            "steady": straight(8),
            "stops": straight(8) * 0,
            "slows": straight(5),
            "hurries": straight(12),
            "moves over": straight(8, left=-3.5),
            "turns": turning,
        }.items()
        for course in [course_of(plan, ego)]
    }
    assert told == {
        "steady": ("maintain speed", "keep lane"),
        "stops": ("stop", "keep lane"),
        "slows": ("decelerate", "keep lane"),
        "hurries": ("accelerate", "keep lane"),
        "moves over": ("maintain speed", "change to right lane"),
        "turns": ("maintain speed", "turn left"),
    }
