"""Where the ego and everybody else will be in half a second (VLA-World, appendix A.2, equations 9 to 11).

Equation 9 takes velocity and acceleration from the last steps of half a second, equation 10 weighs that
acceleration against the one that a mission goal asks for, equation 11 moves on with the weighted one. As
steps are as long as the time ahead, the three come to

    step ahead = (1 - weight) * (last step + half of its change) + weight * ideal step of the goal

where ``weight`` is the paper's lambda. The paper leaves open how lambda adapts and what a goal's ideal step
is: here both are fitted on labelled scenes, for each goal. It also leaves open in which frame steps are
compared: here each is seen from the pose at which it began, so that a steady turn stays one.

A constant acceleration is not met exactly: a velocity out of the last step is that in the middle of the step,
so that equation 11 is half a step's change behind, 0.125 m for each m/s².
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.agents import Agent
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import HISTORY_STEPS, STEP_S, FloatArray, wrap_angle

Array = npt.NDArray[np.float64]

AHEAD_S: Final = 0.5
"""How far ahead is predicted; steps of the past are as long."""
_ROWS: Final = round(AHEAD_S / STEP_S)
AHEAD_ROW: Final = _ROWS - 1
"""The row of a trajectory at 10 Hz, or of an agent's future, that is as far ahead."""
_PAST: Final = (HISTORY_STEPS - 1 - 2 * _ROWS, HISTORY_STEPS - 1 - _ROWS, HISTORY_STEPS - 1)
"""Rows of a history 1.0 s ago, 0.5 s ago and now."""

MissionGoal = Literal["left", "forward", "right"]
_GOAL_POINT: Final = 4
"""The point of a route that decides on the goal, 20 m ahead."""
_GOAL_M: Final = 2.0
"""Metres to a side there that make a turn: a lane's bend of 100 m radius leads as far."""
_FEWEST: Final = 8
"""Scenes of a goal that its ideal step is fitted on, at least."""


class ShortTermError(ValueError):
    """A predictor that cannot be fitted, or cannot predict; the text says why."""


def mission_goal(route: FloatArray) -> MissionGoal:
    """Which way a route [20, 2] leads next."""
    left_m = float(route[_GOAL_POINT, 1])
    if abs(left_m) < _GOAL_M:
        return "forward"
    return "left" if left_m > 0 else "right"


@dataclass(frozen=True)
class GoalFit:
    """What a mission goal does to the next half second.

    Attributes:
        weight: the paper's lambda, 0 to 1; with 0 the goal changes nothing.
        ahead_m, left_m: the ideal step, each as its value at standstill and what a metre of the last step
            adds to it.
    """

    weight: float
    ahead_m: tuple[float, float]
    left_m: tuple[float, float]

    def ideal(self, last_m: npt.ArrayLike) -> Array:
        """Ideal steps [..., 2] in metres where the last ones were ``last_m`` [...] long."""
        length = np.asarray(last_m, np.float64)
        return np.stack([at + gain * length for at, gain in (self.ahead_m, self.left_m)], axis=-1)


@dataclass(frozen=True)
class ShortTermPredictor:
    """Predicts poses in `AHEAD_S`; without goals it is the paper's with lambda = 0.

    Attributes:
        goals: what was fitted for each mission goal; the ego keeps on as it is for one that is missing.
    """

    goals: Mapping[MissionGoal, GoalFit]

    def ego(self, history: FloatArray, goal: MissionGoal | None) -> Array:
        """The ego's pose [3] (x, y, heading) in half a second, in the ego frame now.

        Args:
            history: float32 [16, 4].
            goal: None where nobody gave one.
        """
        past = history[list(_PAST)][:, [0, 1, 3]].astype(np.float64)
        fit = None if goal is None else self.goals.get(goal)
        return _moved_on(past[-1], steps(past), fit)

    def agents(self, agents: Iterable[Agent]) -> Array:
        """Poses [n, 3] (x, y, heading) of agents in half a second, in the ego frame now.

        An agent's goal is not known: it moves on as it did. NaN for one that was not there 0.5 s ago; one
        that was not there 1.0 s ago keeps its velocity.
        """
        past = [agent.poses[list(_PAST)].astype(np.float64) for agent in agents]
        return np.array([_moved_on(poses[-1], steps(poses), None) for poses in past]).reshape(-1, 3)


INERTIA: Final = ShortTermPredictor({})
"""The predictor with lambda = 0: momentum alone."""


def steps(past: Array) -> Array:
    """The two steps [2, 3] between three poses [3, 3], oldest first, each seen from where it began.

    A step is metres ahead, metres to the left, and the turn in radians. The first step is as the last one
    where the oldest pose is not known.
    """
    moved = np.diff(past[:, :2], axis=0)
    heading = past[:-1, 2]
    cos, sin = np.cos(heading), np.sin(heading)
    told = np.stack(
        [
            cos * moved[:, 0] + sin * moved[:, 1],
            -sin * moved[:, 0] + cos * moved[:, 1],
            wrap_angle(np.diff(past[:, 2])),
        ],
        axis=1,
    )
    return told if np.isfinite(told[0]).all() else told[[1, 1]]


def inertial_step(two: Array) -> Array:
    """The next step [2] in metres of equations 9 and 11 with lambda = 0, from the last ``two`` [2, 3]."""
    last, change = two[1, :2], two[1, :2] - two[0, :2]
    # v * tau + 1/2 * a * tau^2, where v * tau is the last step and a * tau^2 its change.
    step: Array = last + change / 2
    return step


def fit_weight(inertial: Array, ideal: Array, actual: Array) -> float:
    """The lambda in 0..1 with which steps [n, 2] come closest to the actual ones, by least squares."""
    towards = ideal - inertial
    spread = float((towards**2).sum())
    if spread == 0:
        return 0.0
    return float(np.clip(((actual - inertial) * towards).sum() / spread, 0.0, 1.0))


def fit_short_term(scenes: Iterable[LabelledScene]) -> ShortTermPredictor:
    """Fit each mission goal's ideal step and lambda on the experts' drives.

    The ideal step is a line over the length of the last step, by least squares. Scenes without a route have
    no goal, and are left out.

    Raises:
        ShortTermError: no goal has enough scenes.
    """
    by_goal: dict[MissionGoal, list[tuple[float, Array, Array]]] = {}
    for labelled in scenes:
        if labelled.scene.route is not None:
            past = labelled.scene.history[list(_PAST)][:, [0, 1, 3]].astype(np.float64)
            two = steps(past)
            actual = labelled.future[AHEAD_ROW, :2].astype(np.float64)
            row = float(np.hypot(*two[1, :2])), inertial_step(two), actual
            by_goal.setdefault(mission_goal(labelled.scene.route), []).append(row)
    fits = {goal: _fit_goal(rows) for goal, rows in by_goal.items() if len(rows) >= _FEWEST}
    if not fits:
        raise ShortTermError(f"no mission goal has {_FEWEST} scenes with a route to fit on")
    return ShortTermPredictor(fits)


def ego_error(pose: npt.NDArray[np.floating], labelled: LabelledScene) -> float:
    """Metres between a pose (x, y, …) that was predicted and where the expert was in half a second."""
    return float(np.hypot(*(pose[:2] - labelled.future[AHEAD_ROW, :2])))


def agent_errors(predictor: ShortTermPredictor, agents: Iterable[Agent]) -> Array:
    """Metres [n] between where agents were predicted and where they were; NaN where either is not known."""
    known = list(agents)
    actual = np.array([agent.future[AHEAD_ROW, :2] for agent in known], np.float64).reshape(-1, 2)
    apart: Array = np.linalg.norm(predictor.agents(known)[:, :2] - actual, axis=1)
    return apart


def _fit_goal(rows: list[tuple[float, Array, Array]]) -> GoalFit:
    length = np.array([row[0] for row in rows])
    inertial, actual = (np.stack([row[part] for row in rows]) for part in (1, 2))
    columns = np.stack([np.ones_like(length), length], axis=1)
    line = np.linalg.lstsq(columns, actual, rcond=None)[0]  # [2 coefficients, 2 axes]
    ahead, left = ((float(at), float(gain)) for at, gain in line.T)
    ideal = GoalFit(0.0, ahead, left).ideal(length)
    return GoalFit(fit_weight(inertial, ideal, actual), ahead, left)


def _moved_on(pose: Array, two: Array, fit: GoalFit | None) -> Array:
    step = inertial_step(two)
    if fit is not None:
        step = (1 - fit.weight) * step + fit.weight * fit.ideal(np.hypot(*two[1, :2]))
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array(
        [
            pose[0] + cos * step[0] - sin * step[1],
            pose[1] + sin * step[0] + cos * step[1],
            wrap_angle(pose[2] + two[1, 2]),
        ]
    )
