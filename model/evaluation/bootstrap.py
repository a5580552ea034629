"""Bootstrap intervals over episodes.

Scenes of one episode resemble each other, so episodes are resampled, not scenes: a draw of as many episodes,
with replacement, brings all their scenes along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from looktwice.model.driving.intervals import Array, Interval, episode_weights, interval_of


class Measured(Protocol):
    """What one scene is worth: its measures are further attributes, float or None."""

    @property
    def scene_id(self) -> str:
        """The scene's own."""

    @property
    def episode_id(self) -> str:
        """Of the episode that it is of."""


def mean_interval(results: Sequence[Measured], measure: str) -> tuple[float | None, Interval | None]:
    """Mean of a measure over the scenes that have it, with its 95 % interval; None where none has it."""
    sums, counts = _per_episode([results], measure)
    if not counts.any():
        return None, None
    return float(sums[0].sum() / counts.sum()), interval_of(_resampled(sums, counts)[0])


@dataclass(frozen=True)
class Comparison:
    """A measure of one variant against another's on the same scenes, with 95 % intervals.

    Attributes:
        name: what is compared.
        measure: an attribute of the results.
        scenes: how many scenes had the measure in both.
        value, against: the two means.
        difference: value - against.
        ratio: value / against; None where ``against`` is zero.
    """

    name: str
    measure: str
    scenes: int
    value: float
    against: float
    difference: float
    difference_interval: Interval
    ratio: float | None
    ratio_interval: Interval | None


def compare(
    name: str, results: Sequence[Measured], against: Sequence[Measured], measure: str = "min_ade_m"
) -> Comparison:
    """Paired comparison: both variants are resampled together, so what scenes share cancels out.

    Raises:
        ValueError: the two are not results of the same scenes, or no scene has the measure in both.
    """
    one, other = ({result.scene_id: result for result in side} for side in (results, against))
    if one.keys() != other.keys():
        raise ValueError(f"{name}: results are not of the same scenes")
    both = [
        scene_id
        for scene_id in one
        if getattr(one[scene_id], measure) is not None and getattr(other[scene_id], measure) is not None
    ]
    if not both:
        raise ValueError(f"{name}: no scene has {measure} in both")
    sums, counts = _per_episode([[side[scene_id] for scene_id in both] for side in (one, other)], measure)
    value, base = (float(side.sum() / counts.sum()) for side in sums)
    resampled = _resampled(sums, counts)
    has_ratio = base != 0.0 and bool((resampled[1] != 0.0).all())
    return Comparison(
        name=name,
        measure=measure,
        scenes=len(both),
        value=value,
        against=base,
        difference=value - base,
        difference_interval=interval_of(resampled[0] - resampled[1]),
        ratio=value / base if base else None,
        ratio_interval=interval_of(resampled[0] / resampled[1]) if has_ratio else None,
    )


def _per_episode(sides: Sequence[Sequence[Measured]], measure: str) -> tuple[Array, Array]:
    """Sums [sides, episodes] of a measure and how many scenes [episodes] have it (in the first side)."""
    episodes = sorted({result.episode_id for result in sides[0]})
    place = {episode: index for index, episode in enumerate(episodes)}
    sums, counts = np.zeros((len(sides), len(episodes))), np.zeros(len(episodes))
    for index, side in enumerate(sides):
        for result in side:
            value = getattr(result, measure)
            if value is not None:
                sums[index, place[result.episode_id]] += value
                counts[place[result.episode_id]] += index == 0
    return sums, counts


def _resampled(sums: Array, counts: Array) -> Array:
    """Means [sides, resamples] over episodes drawn with replacement; episodes without the measure are out."""
    present = counts > 0
    sums, counts = sums[:, present], counts[present]
    episodes = len(counts)
    weights = episode_weights(episodes)
    means: Array = (sums @ weights.T) / (counts @ weights.T)
    return means
