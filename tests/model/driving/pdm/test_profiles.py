"""The fits of speed and curvature, where NAVSIM's pseudo-inverse is known to fail on some machines."""

from __future__ import annotations

from fractions import Fraction
from typing import Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from looktwice.model.driving.pdm.profiles import (
    CURVATURE_RATE_PENALTY,
    INITIAL_CURVATURE_PENALTY,
    SolveError,
    curvature_fit,
    profiles,
)
from looktwice.model.driving.pdm.world import STEP_S, Array

# A car that creeps, stands and creeps on while its heading wavers: millimetres per second, radians a step.
CREEPING_MMPS: Final = (
    *(7.3e-4, 7.1e-4, 6.6e-4, 5.2e-4, 3.1e-4, 1.2e-4, 4.0e-5, 9.0e-6, 1.0e-6, 2.0e-7),
    *(3.0e-8, 0.0, 0.0, 0.0, -2.0e-8, -5.0e-7, -3.0e-6, -1.1e-5, -4.6e-5, -9.0e-5),
    *(-1.3e-4, -9.0e-5, -2.0e-5, 6.0e-6, 4.4e-5, 8.9e-5, 1.7e-4, 2.5e-4, 3.2e-4, 3.8e-4),
    *(4.1e-4, 4.2e-4, 4.0e-4, 3.5e-4, 2.9e-4, 2.2e-4, 1.6e-4, 1.1e-4, 7.0e-5, 5.0e-5),
)
WAVERING_RAD: Final = (
    *(0.011, -0.007, 0.013, 0.002, -0.019, 0.008, 0.004, -0.003, 0.012, -0.011),
    *(0.006, 0.001, -0.002, 0.015, -0.013, 0.009, -0.001, 0.003, -0.008, 0.010),
    *(-0.004, 0.017, -0.006, 0.005, 0.002, -0.012, 0.014, -0.010, 0.007, 0.001),
    *(0.003, -0.015, 0.018, -0.002, 0.006, -0.005, 0.009, -0.014, 0.004, 0.008),
)


def exact(speeds: Array, turns: Array) -> Array:
    """The fitted curvatures in rational arithmetic, rounded once at the end."""
    step, count = Fraction(STEP_S), len(speeds)
    tie = Fraction(CURVATURE_RATE_PENALTY / STEP_S**2)
    diagonal = [(Fraction(float(speed)) * step) ** 2 for speed in speeds]
    right = [
        Fraction(float(speed)) * step * Fraction(float(turn))
        for speed, turn in zip(speeds, turns, strict=True)
    ]
    diagonal[0] += Fraction(INITIAL_CURVATURE_PENALTY)
    for row in range(count):
        diagonal[row] += tie * ((row > 0) + (row < count - 1))
    for row in range(1, count):
        factor = -tie / diagonal[row - 1]
        diagonal[row] += factor * tie
        right[row] -= factor * right[row - 1]
    solution = [right[-1] / diagonal[-1]]
    for row in range(count - 2, -1, -1):
        solution.insert(0, (right[row] + tie * solution[0]) / diagonal[row])
    return np.array([float(value) for value in solution])


def test_an_ill_conditioned_system_is_solved_to_the_last_digits() -> None:
    speeds, turns = np.array(CREEPING_MMPS) * 1e-3, np.array(WAVERING_RAD)
    design = np.tril(np.ones((40, 40)) * STEP_S)
    design[:, 0] = 1.0
    design *= speeds[:, None] * STEP_S
    normal = design.T @ design + np.diag([INITIAL_CURVATURE_PENALTY, *[CURVATURE_RATE_PENALTY] * 39])
    assert np.linalg.cond(normal) > 1e7
    assert curvature_fit(speeds[None], turns[None])[0] == pytest.approx(exact(speeds, turns), rel=1e-12)


@settings(deadline=None, max_examples=20)
@given(st.floats(-9, 1.3), st.lists(st.floats(-0.2, 0.2), min_size=40, max_size=40))
def test_any_speed_is_fitted_as_exactly(exponent: float, turns: list[float]) -> None:
    speeds = 10.0**exponent * (1 + 0.3 * np.sin(np.arange(40.0)))
    found = curvature_fit(speeds[None], np.array(turns)[None])[0]
    expected = exact(speeds, np.array(turns))
    assert np.abs(found - expected).max() <= 1e-11 * max(np.abs(expected).max(), 1e-12)


def test_what_cannot_be_solved_is_told() -> None:
    speeds = np.full((1, 40), np.nan)
    with pytest.raises(SolveError, match="off by"):
        curvature_fit(speeds, np.zeros((1, 40)))


def test_a_circle_at_constant_speed_has_its_speed_and_curvature() -> None:
    turned = np.arange(41) * 0.1 * 8.0 / 50.0
    poses = np.stack([50 * np.sin(turned), 50 * (1 - np.cos(turned)), turned], axis=-1)
    speeds, curvatures = profiles(poses[None])
    assert speeds[0, 5:-5] == pytest.approx(np.full(30, 8.0), rel=2e-3)
    assert curvatures[0] == pytest.approx(np.full(40, 0.02), rel=2e-3)
