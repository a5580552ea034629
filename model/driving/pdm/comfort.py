"""Comfort: smoothed accelerations and turns of states, against nuPlan's bounds.

Source: NAVSIM's comfort metrics; the smoothing is that of Savitzky and Golay with polynomials fitted at
both ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Final, Literal

import numpy as np

from looktwice.model.driving.pdm.geometry import IndexArray
from looktwice.model.driving.pdm.world import (
    ACCELERATION,
    ACCELERATION_Y,
    HEADING,
    STEP_S,
    YAW_ACCELERATION,
    YAW_RATE,
    Array,
    BoolArray,
    EgoVehicle,
    ScoreError,
)

Version = Literal["v1.1", "v2.2"]

MAX_ACCELERATION: Final = 2.40
MIN_ACCELERATION: Final = -4.05
MAX_LATERAL_ACCELERATION: Final = 4.89
MAX_JERK: Final = 8.37
MAX_LONGITUDINAL_JERK: Final = 4.13
MAX_YAW_RATE: Final = 0.95
MAX_YAW_ACCELERATION: Final = 1.93

EXTENDED: Final = (
    ("acceleration_change", 0.7),
    ("jerk_change", 0.5),
    ("yaw_rate_change", 0.1),
    ("yaw_acceleration_change", 0.1),
)
"""The bounds of extended comfort, in SI units."""

MOST_SECONDS_BETWEEN: Final = 0.55
_DECIMALS: Final = 8


@dataclass(frozen=True, eq=False)
class Comfort:
    """Whether plans are comfortable, and which bound they break first.

    Attributes:
        holds: bool [n].
        first_step: int [n], the step at which a bound is broken first, counted from now; -1 where none is.
        bound: the broken bound's name, a plan each; "" where none is.
    """

    holds: BoolArray
    first_step: IndexArray
    bound: tuple[str, ...]


@dataclass(frozen=True)
class Excess:
    """A bound that a plan breaks: its name, the plan's worst value, and the limit that it is beyond."""

    bound: str
    value: float
    limit: float


def comfort(states: Array, vehicle: EgoVehicle, version: Version, past: Array | None = None) -> Comfort:
    """Comfort of simulated ``states`` [n, 41, 11], with the ``past`` [h, 11] before them in v2.2."""
    states, before = _behind(states, past)
    bounds = _bounds(states, vehicle, version)
    broken = [each.broken for each in bounds]
    first = np.stack([np.where(each.any(axis=1), each.argmax(axis=1), states.shape[1]) for each in broken])
    worst = first.argmin(axis=0)
    earliest = first.min(axis=0)
    holds = earliest == states.shape[1]
    bound = tuple("" if fine else bounds[kind].name for fine, kind in zip(holds, worst, strict=True))
    return Comfort(holds, np.where(holds, -1, np.maximum(earliest - before, 0)), bound)


def excesses(states: Array, vehicle: EgoVehicle, version: Version, past: Array | None = None) -> list[Excess]:
    """The bounds that one plan's ``states`` [1, 41, 11] break, and its worst values; see `comfort`."""
    found = []
    for bound in _bounds(_behind(states, past)[0], vehicle, version):
        if bound.broken.any():
            values = bound.values[0]
            above, below = values - bound.high, bound.low - values
            worst = int(np.maximum(above, below).argmax())
            limit = bound.high if above[worst] >= below[worst] else bound.low
            found.append(Excess(bound.name, float(values[worst]), limit))
    return found


def _behind(states: Array, past: Array | None) -> tuple[Array, int]:
    """States with the past before them, and how many rows of it there are."""
    if past is None:
        return states, 0
    # NAVSIM leaves the last of them out: its past ends at -0.2 s, and the plan begins at 0 s.
    past = past[:-1].copy()
    # ... and knows no turn: nuPlan's interpolated states have none.
    past[:, [YAW_RATE, YAW_ACCELERATION]] = 0.0
    repeated = np.broadcast_to(past, (len(states), *past.shape))
    return np.concatenate([repeated, states], axis=1), len(past)


@dataclass(frozen=True, eq=False)
class _Bound:
    """What a bound holds, [n, t], and between which values."""

    name: str
    values: Array
    low: float
    high: float

    @property
    def broken(self) -> BoolArray:
        result: BoolArray = ~((self.values > self.low) & (self.values < self.high))
        return result


def _bounds(states: Array, vehicle: EgoVehicle, version: Version) -> list[_Bound]:
    """All bounds, in the order in which they are told."""
    count = states.shape[1]
    longitudinal, lateral = states[..., ACCELERATION], states[..., ACCELERATION_Y]
    magnitude = np.hypot(longitudinal, lateral)
    if version == "v2.2":
        longitudinal, lateral = _shifted(states, vehicle)
        window, jerk_window = 8, 15
    else:
        window, jerk_window = count, count
    jerk, longitudinal_jerk = (
        _smooth(_smooth(each, 8, 2), jerk_window, 2, 1) for each in (magnitude, longitudinal)
    )
    longitudinal, lateral = _smooth(longitudinal, window, 2), _smooth(lateral, window, 2)
    heading = _unwrapped(states[..., HEADING])

    def within(name: str, values: Array, most: float) -> _Bound:
        return _Bound(name, values, -most, most)

    return [
        _Bound("longitudinal_acceleration", longitudinal, MIN_ACCELERATION, MAX_ACCELERATION),
        within("lateral_acceleration", lateral, MAX_LATERAL_ACCELERATION),
        within("jerk", jerk, MAX_JERK),
        within("longitudinal_jerk", longitudinal_jerk, MAX_LONGITUDINAL_JERK),
        within("yaw_acceleration", _smooth(heading, 5, 3, 2), MAX_YAW_ACCELERATION),
        within("yaw_rate", _smooth(heading, 5, 2, 1), MAX_YAW_RATE),
    ]


def extended_comfort(states: Array, previous: Array, seconds_between: float) -> BoolArray:
    """Whether plans go on as the plan before them began: bool [n].

    Args:
        states: [n, 41, 11], simulated, from now on.
        previous: [41, 11] or [n, 41, 11], simulated, from an earlier moment on; motion, not pose, matters.
        seconds_between: how much earlier, above 0 and below 0.55.

    Raises:
        ScoreError: moments too far apart.
    """
    result = np.ones(len(states), dtype=np.bool_)
    for change, (_, bound) in zip(_changes(states, previous, seconds_between), EXTENDED, strict=True):
        result &= change <= bound
    return result


def extended_excesses(states: Array, previous: Array, seconds_between: float) -> list[Excess]:
    """The bounds of `extended_comfort` that one plan's ``states`` [1, 41, 11] break."""
    changes = _changes(states, previous, seconds_between)
    return [
        Excess(name, float(change[0]), bound)
        for change, (name, bound) in zip(changes, EXTENDED, strict=True)
        if not change[0] <= bound
    ]


def _changes(states: Array, previous: Array, seconds_between: float) -> list[Array]:
    """Of each feature the root of the mean square by which plans differ from the one before, [n] each."""
    if not STEP_S / 2 <= seconds_between < MOST_SECONDS_BETWEEN:
        raise ScoreError("previous", f"lies {STEP_S} to {MOST_SECONDS_BETWEEN} s back, not {seconds_between}")
    shift = round(seconds_between / STEP_S)
    earlier = np.broadcast_to(previous, states.shape)
    ours, theirs = (_features(each) for each in (states[:, :-shift], earlier[:, shift:]))
    return [np.sqrt(((one - other) ** 2).mean(axis=1)) for one, other in zip(ours, theirs, strict=True)]


def _features(states: Array) -> tuple[Array, Array, Array, Array]:
    acceleration = _smooth(np.hypot(states[..., ACCELERATION], states[..., ACCELERATION_Y]), 8, 2)
    heading = _unwrapped(states[..., HEADING])
    jerk = _smooth(acceleration, 15, 2, 1)
    return acceleration, jerk, _smooth(heading, 5, 2, 1), _smooth(heading, 5, 2, 2)


def _shifted(states: Array, vehicle: EgoVehicle) -> tuple[Array, Array]:
    """Acceleration of the box's centre in m/s², forward and to the left.

    NAVSIM adds the turn's two terms along the car's axis both; physics has one of them to the side. This
    is NAVSIM's.
    """
    turning = states[..., YAW_RATE] ** 2 + states[..., YAW_ACCELERATION]
    return states[..., ACCELERATION] + vehicle.centre_m * turning, states[..., ACCELERATION_Y]


def _unwrapped(heading: Array) -> Array:
    result = heading.copy()
    result[..., 1:] -= 2 * np.pi * np.cumsum(np.round(np.diff(heading, axis=-1) / (2 * np.pi)), axis=-1)
    return result


def _smooth(values: Array, window: int, order: int, derivative: int = 0) -> Array:
    count = values.shape[-1]
    filter_ = _filter(count, min(window, count), order, derivative)
    result: Array = np.round(values @ filter_.T, _DECIMALS)
    return result


@cache
def _filter(count: int, window: int, order: int, derivative: int) -> Array:
    """The filter as a matrix [count, count]; a window of even length reaches one step farther ahead."""
    if order >= window:
        raise ScoreError("past", "too few states to smooth")
    half = window // 2
    matrix = np.zeros((count, count))
    for row in range(count):
        if row < half:
            start, at = 0, float(row)
        elif row >= count - half:
            start, at = count - window, float(row - (count - window))
        else:
            start, at = row - (window - 1) // 2, (window - 1) / 2
        matrix[row, start : start + window] = _weights(window, order, derivative, at)
    return matrix


def _weights(window: int, order: int, derivative: int, at: float) -> Array:
    """Weights of a window's values in the derivative at ``at`` of the polynomial fitted to them."""
    basis, triangle = np.linalg.qr(np.vander(np.arange(window) - at, order + 1, increasing=True))
    row: Array = np.linalg.solve(triangle, basis.T)[derivative]
    return row * math.factorial(derivative) / STEP_S**derivative
