"""The search for the highest rate that is sustained; no input or output."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class KneeSearch:
    """Rates to try: up by ``growth`` until one is too high, then halving the gap (of logarithms).

    Attributes:
        first_rps: where the search begins.
        growth: factor from one rate to the next.
        precision: the search ends when the lowest rate that was too high is no more than this above the
            highest one that was sustained, as a share.
        least_rps: the lowest rate that is tried.
        most_points: rates tried at most.
    """

    first_rps: float
    growth: float = 2.0
    precision: float = 0.1
    least_rps: float = 0.2
    most_points: int = 14

    def __post_init__(self) -> None:
        if self.first_rps < self.least_rps or self.growth <= 1 or self.precision <= 0:
            raise ValueError(
                f"a search begins at {self.least_rps} requests a second or above, grows by a factor above 1, "
                "and has a precision above 0"
            )

    def next_rps(self, sustained: Mapping[float, bool]) -> float | None:
        """The rate to try next, given whether each tried rate was sustained; None when all is known."""
        if not sustained:
            return self.first_rps
        if len(sustained) >= self.most_points:
            return None
        too_high = min((rate for rate, held in sustained.items() if not held), default=math.inf)
        held = knee_rps(sustained)
        if held is None:
            return max(too_high / self.growth, self.least_rps) if too_high > self.least_rps else None
        if too_high == math.inf:
            return held * self.growth
        return math.sqrt(held * too_high) if too_high / held > 1 + self.precision else None


def knee_rps(sustained: Mapping[float, bool]) -> float | None:
    """The highest rate below which, itself included, every rate that was tried was sustained."""
    too_high = min((rate for rate, held in sustained.items() if not held), default=math.inf)
    return max((rate for rate, held in sustained.items() if held and rate < too_high), default=None)
