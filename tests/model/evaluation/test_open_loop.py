from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.plan import MetaAction, Plan, plan_iou
from looktwice.model.evaluation.open_loop import (
    BASELINES,
    EXPERT,
    MEASURES,
    SceneResult,
    evaluate_baselines,
    evaluate_draws,
    evaluate_trajectories,
)
from tests.model.driving.drives import MIDDLES_S, agent, labelled_scene
from tests.model.evaluation.fakes import draw_of, offset


def test_the_measures_of_three_draws_by_hand() -> None:
    # Road from -5.25 to 5.25, ego 1.85 wide: off the road from 4.325 m aside. A car stands 30 m ahead.
    labelled = labelled_scene(10.0, agents=(agent(30, 3.5),))
    draws = [draw_of(offset(labelled.future, metres), tokens=30) for metres in (0.0, 3.0, 6.0)]
    result = evaluate_draws(labelled, draws)
    assert result.min_ade_m == 0.0
    assert result.avg_ade_m == pytest.approx(3.0)
    assert result.avg_fde_m == pytest.approx(3.0)
    assert result.corner_distance_m == 0.0
    assert result.collision_rate == pytest.approx(1 / 3)  # 3 m aside meets the car, 0 and 6 do not
    assert result.off_road_rate == pytest.approx(1 / 3)
    assert result.output_tokens == 30
    assert (result.plan_iou_first, result.think_rate) == (None, None)
    assert result.tags == {"lead_vehicle"}


def test_trajectories_with_times_of_their_own_are_measured_at_these() -> None:
    labelled = labelled_scene(10.0, agents=(agent(30, 3.5),))
    times_s = (0.5, 1.0, 1.5, 2.0)
    expert = labelled.future[[4, 9, 14, 19]]
    draws = [replace(draw_of(offset(expert, metres)), times_s=times_s) for metres in (0.0, 3.0, 6.0)]
    result = evaluate_draws(labelled, draws, greedy=draws[1])
    assert (result.min_ade_m, result.corner_distance_m) == (0.0, 0.0)
    assert result.avg_ade_m == result.avg_fde_m == result.greedy_ade_m == result.agreed_ade_m
    assert result.avg_ade_m == pytest.approx(3.0)
    # The car stands 30 m ahead, which is 3 s away; the paths end after 2 s.
    assert result.collision_rate == 0.0
    assert result.off_road_rate == pytest.approx(1 / 3)
    assert result.path_error_m == pytest.approx(34**0.5 - 5, abs=1e-3)  # 3 m aside in the first half second


def test_without_a_known_road_nobody_leaves_it() -> None:
    labelled = replace(labelled_scene(), drivable=())
    assert evaluate_trajectories(labelled, labelled.future[None]).off_road_rate is None


def test_plans_are_measured_first_and_last() -> None:
    labelled = labelled_scene(np.maximum(0, 10 - 2 * np.maximum(MIDDLES_S, 0)))
    expert = expert_plan(labelled)
    assert [action.word for action in expert.longitudinal or ()] == ["Decelerate", "Wait"]
    wrong = replace(expert, longitudinal=(MetaAction(0, 64, "Keep Speed"),))
    draws = [draw_of(labelled.future, wrong, revised=expert), draw_of(labelled.future, wrong, index=1)]
    result = evaluate_draws(labelled, draws)
    assert result.plan_iou_first == result.plan_iou_best == pytest.approx(2 / 4)  # two groups of three agree
    assert result.plan_iou_revised == pytest.approx((1 + 2 / 4) / 2)
    assert result.think_rate == 0.5
    better = evaluate_draws(labelled, [draws[0], draw_of(labelled.future, expert, index=1)])
    assert better.plan_iou_best == 1.0


def test_where_no_lanes_are_known_a_plan_that_speaks_of_them_is_not_punished() -> None:
    labelled = replace(labelled_scene(), lane_trace=None)
    expert = expert_plan(labelled)
    assert expert.lane is None
    spoken = replace(expert, lane=(MetaAction(0, 64, "Keep Lane"),))
    assert plan_iou(spoken, expert) < 1
    assert evaluate_draws(labelled, [draw_of(labelled.future, spoken)]).plan_iou_first == 1.0


def test_a_plan_without_a_group_the_expert_has_is_punished() -> None:
    labelled = labelled_scene()
    short = Plan(lateral=expert_plan(labelled).lateral)
    assert evaluate_draws(labelled, [draw_of(labelled.future, short)]).plan_iou_first == pytest.approx(1 / 3)


def test_no_draws_are_an_error() -> None:
    with pytest.raises(ValueError, match="scene has no draws"):
        evaluate_draws(labelled_scene(), [])


def test_baselines_are_right_where_their_assumption_holds() -> None:
    straight, arc = labelled_scene(10.0), labelled_scene(10.0, 0.2)
    results = evaluate_baselines(iter([straight, arc]))
    assert list(results) == [EXPERT, *BASELINES]
    expert, velocity, turn_rate = results.values()
    assert [result.agreed_ade_m for result in expert] == [0.0, 0.0]
    assert [result.path_error_m for result in expert] == [0.0, 0.0]
    assert velocity[0].min_ade_m < 1e-3
    assert velocity[1].min_ade_m > 5
    assert turn_rate[1].avg_ade_m < 1e-3


def test_every_measure_is_a_field() -> None:
    assert set(MEASURES) <= set(SceneResult.__dataclass_fields__)


def test_the_draw_that_is_driven_by_has_measures_of_its_own() -> None:
    scene = labelled_scene(10.0)
    away = [offset(scene.future, metres) for metres in (0.0, 2.0, 3.0)]
    greedy = draw_of(offset(scene.future, 0.25), expert_plan(scene))
    result = evaluate_draws(scene, [draw_of(each, expert_plan(scene)) for each in away], greedy)
    assert result.agreed_ade_m == pytest.approx(2.0, abs=1e-5)
    assert result.greedy_ade_m == pytest.approx(0.25, abs=1e-5)
    assert result.path_m == pytest.approx(64.0 + result.path_error_m, abs=0.01)
    assert evaluate_draws(scene, [greedy]).greedy_ade_m is None


def test_a_trajectory_that_does_what_its_plan_says_agrees_with_it() -> None:
    steady, braking = labelled_scene(10.0), labelled_scene(10.0 - 1.2 * np.maximum(MIDDLES_S, 0))
    says, does = expert_plan(steady), braking.future
    assert evaluate_draws(steady, [draw_of(steady.future, says)]).agreement_plan_trajectory == 1.0
    part = evaluate_draws(steady, [draw_of(does, says)]).agreement_plan_trajectory
    assert part is not None
    assert part < 0.7
    # What counts is the plan that the trajectory follows: the last one.
    revised = draw_of(does, says, revised=expert_plan(braking))
    assert evaluate_draws(steady, [revised]).agreement_plan_trajectory == pytest.approx(1.0, abs=0.1)


def test_reasonings_are_held_against_the_change_and_the_view() -> None:
    braking = labelled_scene(10.0 - 1.2 * np.maximum(MIDDLES_S, 0), agents=(agent(30, 0.0),))
    keeps, brakes = expert_plan(labelled_scene(10.0)), expert_plan(braking)
    right = replace(
        draw_of(braking.future, keeps, revised=brakes),
        thinking="A car stands in my lane, some 25 metres ahead, so I should slow down.",
    )
    wrong = replace(right, index=1, thinking="A cone frumbles in my lane, so I should accelerate.")
    result = evaluate_draws(braking, [right, wrong, draw_of(braking.future, keeps, index=2)])
    assert (result.agreement_reason_change, result.agreement_reason_view) == (0.5, 0.5)
    assert result.unknown_words == 0.5
    direct = evaluate_draws(braking, [draw_of(braking.future, keeps)])
    assert (direct.agreement_reason_change, direct.unknown_words) == (None, None)


def test_a_lead_is_soon_met_by_who_drives_fast() -> None:
    lead = agent(45.0, 0.0, speed=5.0)
    draws = [draw_of(labelled_scene(10.0).future)]
    assert not evaluate_draws(labelled_scene(5.0, agents=(lead,)), draws).lead_soon
    fast = evaluate_draws(labelled_scene(15.0, agents=(lead,)), draws)
    assert fast.lead_soon
    assert not fast.lead_close
