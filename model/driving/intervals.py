"""Bootstrap intervals: how far a figure would move with other episodes.

Scenes and kilometres of one episode resemble each other, so episodes are drawn, with replacement.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Interval = tuple[float, float]

RESAMPLES: Final = 2000
"""Enough that a 95 % bound moves by about a hundredth of the interval's width from seed to seed."""
_SEED: Final = 20_240_601


def episode_weights(episodes: int) -> Array:
    """How often each of so many episodes is drawn, [RESAMPLES, episodes]; the same for the same number."""
    random = np.random.default_rng(_SEED)
    return random.multinomial(episodes, np.full(episodes, 1 / episodes), RESAMPLES).astype(np.float64)


def interval_of(values: Array) -> Interval:
    """The middle 95 % of resampled figures."""
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


def ratio_interval(amounts: Array, by: Array) -> Interval:
    """The 95 % interval of sum(amounts) / sum(by) over episodes [n]; draws without any ``by`` count as 0."""
    return interval_of(_resampled_ratios(amounts, by))


def ratio_difference_interval(amounts: Array, by: Array, others: Array, others_by: Array) -> Interval:
    """The same of the ratio's difference from sum(others) / sum(others_by) over the same episodes [n].

    Both ratios are of the same drawn episodes, so what they share cancels out.
    """
    return interval_of(_resampled_ratios(amounts, by) - _resampled_ratios(others, others_by))


def _resampled_ratios(amounts: Array, by: Array) -> Array:
    weights = episode_weights(len(amounts))
    totals = weights @ by
    return np.divide(weights @ amounts, totals, out=np.zeros(len(weights)), where=totals > 0)
