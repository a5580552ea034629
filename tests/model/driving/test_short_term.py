from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.agents import Agent
from looktwice.model.driving.paper_axes import from_paper_axes, to_paper_axes
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.short_term import (
    INERTIA,
    GoalFit,
    ShortTermError,
    ShortTermPredictor,
    agent_errors,
    ego_error,
    fit_short_term,
    fit_weight,
    inertial_step,
    mission_goal,
    steps,
)
from looktwice.model.driving.trajectory import FloatArray, from_ego_frame, wrap_angle
from tests.model.driving.drives import ROWS_S, agent, drive, labelled_scene

speeds_ms = st.floats(-3, 30)
yaw_rates = st.floats(-0.8, 0.8)
LEFT = np.stack([4.0 * np.arange(1, 21), 3 + 0.2 * np.arange(20)], 1).astype(np.float32)


def turning(speed: float, yaw_rate: float, x: float, y: float, heading: float) -> Agent:
    """An agent that drives a circle, and is at (x, y) now."""
    future, history = drive(speed, yaw_rate)
    poses = from_ego_frame(np.concatenate([history, future]), [x, y, 0.0, heading])
    return Agent(1, "vehicle", 4.4, 1.8, 1.5, poses[:, [0, 1, 3]].astype(np.float32))


@given(speed=speeds_ms, yaw_rate=yaw_rates)
def test_a_steady_drive_is_met_exactly(speed: float, yaw_rate: float) -> None:
    future, history = drive(speed, yaw_rate)
    pose = INERTIA.ego(history, None)
    np.testing.assert_allclose(pose[:2], future[4, :2], atol=1e-3)
    assert abs(wrap_angle(pose[2] - future[4, 3])) < 1e-4


@given(
    speed=speeds_ms,
    yaw_rate=yaw_rates,
    x=st.floats(-40, 40),
    y=st.floats(-40, 40),
    heading=st.floats(-3, 3),
)
def test_a_steady_agent_is_met_exactly(
    speed: float, yaw_rate: float, x: float, y: float, heading: float
) -> None:
    there = turning(speed, yaw_rate, x, y, heading)
    [pose] = INERTIA.agents([there])
    np.testing.assert_allclose(pose[:2], there.future[4, :2], atol=2e-3)
    assert abs(wrap_angle(pose[2] - there.future[4, 2])) < 1e-4
    assert agent_errors(INERTIA, [there]) == pytest.approx([0.0], abs=2e-3)


@pytest.mark.parametrize("acceleration_ms2", [2.0, -3.0])
def test_a_constant_acceleration_is_an_eighth_of_a_metre_behind_for_each_metre_a_second_squared(
    acceleration_ms2: float,
) -> None:
    """Equation 9 tells the velocity in the middle of the last step: the module's first lines."""
    away_m = 10 * ROWS_S + acceleration_ms2 * ROWS_S**2 / 2
    future, history = drive(np.diff(away_m) / 0.1)
    assert future[4, 0] - INERTIA.ego(history, None)[0] == pytest.approx(0.125 * acceleration_ms2, abs=1e-3)


@given(points=st.lists(st.tuples(*[st.floats(-50, 50)] * 6), min_size=1, max_size=1))
def test_without_turns_it_is_what_the_equations_say(points: list[tuple[float, ...]]) -> None:
    before, last, now = np.array(points[0]).reshape(3, 2)
    velocity_ms, earlier_ms = (now - last) / 0.5, (last - before) / 0.5
    acceleration_ms2 = (velocity_ms - earlier_ms) / 0.5
    expected = now + velocity_ms * 0.5 + acceleration_ms2 * 0.5**2 / 2
    past = np.array([[*before, 0.0], [*last, 0.0], [*now, 0.0]])
    np.testing.assert_allclose(now + inertial_step(steps(past)), expected, atol=1e-9)


def test_agents_that_came_late() -> None:
    new, newer = agent(10.0, 0.0, speed=4.0), agent(10.0, 0.0, speed=4.0)
    new.poses[:10] = np.nan
    newer.poses[:15] = np.nan
    kept, unknown = INERTIA.agents([new, newer])
    np.testing.assert_allclose(kept, [12.0, 0.0, 0.0], atol=1e-5)
    assert np.isnan(unknown).all()
    assert np.isnan(agent_errors(INERTIA, [newer])).all()
    assert INERTIA.agents([]).shape == (0, 3)


@given(weight=st.floats(0, 1), seed=st.integers(0, 9))
def test_the_fit_finds_a_known_weight(weight: float, seed: int) -> None:
    inertial, ideal = np.random.default_rng(seed).normal(size=(2, 50, 2))
    actual = (1 - weight) * inertial + weight * ideal
    assert fit_weight(inertial, ideal, actual) == pytest.approx(weight, abs=1e-9)


def test_a_weight_stays_between_none_and_all() -> None:
    zero, one = np.zeros((4, 2)), np.ones((4, 2))
    assert fit_weight(zero, one, 3 * one) == 1.0
    assert fit_weight(zero, one, -one) == 0.0
    assert fit_weight(one, one, 3 * one) == 0.0


def scene(speed: float, future: FloatArray, route: FloatArray | None) -> LabelledScene:
    made = labelled_scene(speed)
    return replace(made, scene=replace(made.scene, route=route), future=future)


def test_a_goal_that_everybody_follows_is_learned() -> None:
    """Everybody who is to turn left goes at half the speed at once: momentum alone knows nothing of it."""
    scenes = []
    for speed in np.linspace(4, 14, 20):
        slower, _ = drive(0.5 * speed)
        scenes.append(scene(float(speed), slower, LEFT))
    fitted = fit_short_term(scenes)
    assert list(fitted.goals) == ["left"]
    assert fitted.goals["left"].weight == pytest.approx(1.0)
    assert fitted.goals["left"].ideal(4.0) == pytest.approx([2.0, 0.0], abs=1e-4)
    for each in scenes:
        assert ego_error(fitted.ego(each.scene.history, "left"), each) < 1e-3
        assert ego_error(INERTIA.ego(each.scene.history, None), each) > 0.9
    # Nothing was learned for another goal, so momentum decides there.
    history = scenes[0].scene.history
    np.testing.assert_array_equal(fitted.ego(history, "right"), INERTIA.ego(history, None))


def test_weights_mix_momentum_and_goal() -> None:
    _, history = drive(10.0)
    half = ShortTermPredictor({"left": GoalFit(0.5, (0.0, 0.6), (1.0, 0.0))})
    assert half.ego(history, "left")[:2] == pytest.approx([0.5 * 5 + 0.5 * 3, 0.5 * 1.0], abs=1e-4)


def test_nothing_to_fit_on_is_an_error() -> None:
    future, _ = drive(5.0)
    with pytest.raises(ShortTermError, match="8 scenes"):
        fit_short_term([scene(5.0, future, LEFT)] * 7 + [scene(5.0, future, None)] * 9)


@pytest.mark.parametrize(("side_m", "goal"), [(1.9, "forward"), (2.1, "left"), (-2.1, "right")])
def test_goals(side_m: float, goal: str) -> None:
    route = np.stack([4.0 * np.arange(1, 21), np.linspace(0, side_m * 19 / 4, 20)], 1).astype(np.float32)
    assert mission_goal(route) == goal


def test_left_is_negative_in_the_paper() -> None:
    np.testing.assert_array_equal(to_paper_axes([[10.0, 2.0]]), [[-2.0, 10.0]])
    points = np.random.default_rng(0).normal(size=(3, 5, 2))
    np.testing.assert_array_equal(from_paper_axes(to_paper_axes(points)), points)
