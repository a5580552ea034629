"""Speed and curvature along a path of poses, by least squares as nuPlan's tracker fits them.

NAVSIM solves the normal equations by a pseudo-inverse, whose accuracy depends on the machine's linear
algebra. Here both systems are solved without one, and what they leave over is checked.
"""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np

from looktwice.model.driving.pdm.world import STEP_S, Array

ACCELERATION_PENALTY: Final = 1e-4
CURVATURE_RATE_PENALTY: Final = 1e-2
INITIAL_CURVATURE_PENALTY: Final = 1e-10
LARGEST_RESIDUAL: Final = 1e-10
"""What a solution may leave over, relative to the size of its system."""


class SolveError(ArithmeticError):
    """A linear system whose solution left too much over."""


def wrapped(angle: Array) -> Array:
    """Angles brought to -pi..pi."""
    result: Array = np.arctan2(np.sin(angle), np.cos(angle))
    return result


def profiles(poses: Array) -> tuple[Array, Array]:
    """Speed and curvature of paths.

    Args:
        poses: [n, t + 1, 3] (x, y, heading) at 10 Hz.

    Returns:
        Speeds in m/s and curvatures in 1/m at the start of each step, [n, t] each.

    Raises:
        SolveError: a fit that is not a solution.
    """
    steps = np.diff(poses, axis=1)
    headings = poses[:, :-1, 2]
    forward = steps[..., 0] * np.cos(headings) + steps[..., 1] * np.sin(headings)
    speeds = forward @ _speed_fit(forward.shape[1]).T
    return speeds, curvature_fit(speeds, wrapped(steps[..., 2]))


@cache
def _speed_fit(count: int) -> Array:
    """The matrix [count, count] from forward steps to speeds.

    A step's direction has length 1, so that the normal equations do not depend on the path.
    """
    design = np.tril(np.full((count, count), STEP_S**2))
    design[:, 0] = STEP_S
    # NAVSIM means to hold down the jerk. Its matrix of differences overwrites its own entries but for the
    # last row, and so holds down the acceleration: the same is done here, for the same score.
    penalised = np.zeros((count - 2, count))
    penalised[:, 1:-1] = -np.eye(count - 2)
    penalised[-1, -1] = 1.0
    normal = design.T @ design + ACCELERATION_PENALTY * penalised.T @ penalised
    solution = np.linalg.solve(normal, design.T)
    solution += np.linalg.solve(normal, design.T - normal @ solution)
    _check(np.abs(normal @ solution - design.T).max(), np.abs(design).max())
    speeds: Array = design @ solution / STEP_S
    return speeds


def curvature_fit(speeds: Array, turns: Array) -> Array:
    """Curvatures [n, t] whose turns come closest to ``turns`` (rad, [n, t]) at ``speeds`` (m/s, [n, t]).

    The unknowns are the curvatures themselves, not their first value and their rates. Each is then tied to
    its neighbours only, and can be eliminated without subtracting what is nearly equal: a car that hardly
    moves makes the system all but singular, and costs no digits.

    Raises:
        SolveError: the solution leaves too much over.
    """
    reach = speeds.T * STEP_S
    own = reach**2
    own[0] += INITIAL_CURVATURE_PENALTY
    right = reach * turns.T
    solution = _eliminate(own, right)
    left_over = right - _product(own, solution)
    solution += _eliminate(own, left_over)
    left_over = np.abs(right - _product(own, solution)).max(axis=0, initial=0)
    size = np.abs(right).max(axis=0, initial=0) + np.abs(solution).max(axis=0, initial=0)
    _check(float(np.max(left_over - LARGEST_RESIDUAL * size, initial=0)), 0.0)
    result: Array = solution.T
    return result


_TIE: Final = CURVATURE_RATE_PENALTY / STEP_S**2
"""What a difference of neighbouring curvatures costs."""


def _eliminate(own: Array, right: Array) -> Array:
    """Solve own[i] x[i] + tie (x[i] - x[i - 1]) + tie (x[i] - x[i + 1]) = right[i], one system a column."""
    count = len(own)
    rest, solution = own.copy(), right.copy()
    for row in range(1, count):
        share = _TIE / (_TIE + rest[row - 1])
        rest[row] += share * rest[row - 1]
        solution[row] += share * solution[row - 1]
    solution[-1] /= rest[-1]
    for row in range(count - 2, -1, -1):
        solution[row] = (solution[row] + _TIE * solution[row + 1]) / (_TIE + rest[row])
    return solution


def _product(own: Array, vector: Array) -> Array:
    difference = _TIE * np.diff(vector, axis=0)
    result: Array = own * vector
    result[:-1] -= difference
    result[1:] += difference
    return result


def _check(left_over: float, size: float) -> None:
    if not left_over <= LARGEST_RESIDUAL * size:
        raise SolveError(f"a fit of a path is off by {left_over:.1e}")
