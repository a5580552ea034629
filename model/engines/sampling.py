"""Choosing a token: exact, in float64, with random numbers that depend on (seed, draw, position) only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_MASK: Final = (1 << 64) - 1


def uniform(seed: int, draw: int, position: int) -> float:
    """A number in [0, 1) for one position of one draw: SplitMix64's finaliser over the three counters.

    Being a pure function of its arguments, a draw is the same alone, in a batch and after a restart.
    """
    state = seed & _MASK
    for counter in (draw, position):
        state = _mix((state ^ _mix(counter + 0x9E3779B97F4A7C15)) & _MASK)
    return (state >> 11) * 2.0**-53


def uniforms(seed: int, draws: Sequence[int], position: int) -> Array:
    """`uniform` of several draws at one position."""
    return np.array([uniform(seed, draw, position) for draw in draws])


def _mix(value: int) -> int:
    value &= _MASK
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & _MASK
    return value ^ (value >> 31)


def probabilities(logits: Array, temperature: float = 1.0) -> Array:
    """Softmax of logits [k] at a temperature above 0, in float64."""
    scaled = (logits - logits.max()) / temperature
    exponentials = np.exp(scaled)
    shares: Array = exponentials / exponentials.sum()
    return shares


def choose(logits: Array, temperature: float, top_p: float, numbers: Array) -> npt.NDArray[np.int64]:
    """The positions in logits [k] that ``numbers`` [n] in [0, 1) select, each by itself.

    Temperature 0 takes the largest logit (the first of equals). Otherwise the inverse of the cumulative
    distribution in the order given; ``top_p`` keeps the likeliest positions up to that mass.
    """
    if temperature == 0.0:
        return np.full(len(numbers), np.argmax(logits))
    mass = probabilities(logits, temperature)
    if top_p < 1.0:
        order = np.argsort(-mass, kind="stable")
        before = np.cumsum(mass[order]) - mass[order]
        mass[order[before >= top_p]] = 0.0
    cumulative = np.cumsum(mass)
    positions = np.searchsorted(cumulative, numbers * cumulative[-1], side="right")
    # Rounding may leave the last sum a hair below the number: the last position with mass takes it.
    chosen: npt.NDArray[np.int64] = np.minimum(positions, np.flatnonzero(mass)[-1])
    return chosen
