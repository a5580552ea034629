"""When requests are due: seeded Poisson arrivals over phases of constant rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Times = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Phase:
    """A stretch of a run.

    Attributes:
        name: as it is called in the report.
        seconds: how long it lasts.
        rate_rps: requests offered per second, on average.
    """

    name: str
    seconds: float
    rate_rps: float

    def __post_init__(self) -> None:
        if self.seconds < 0 or self.rate_rps < 0:
            raise ValueError(f"phase {self.name}: neither time nor rate can be negative")


@dataclass(frozen=True)
class Window:
    """A phase on the clock of its run: ``start_s`` <= t < ``end_s``."""

    name: str
    start_s: float
    end_s: float

    @property
    def seconds(self) -> float:
        """How long it is."""
        return self.end_s - self.start_s


def windows(phases: Sequence[Phase]) -> list[Window]:
    """Where each phase lies, one behind the other from 0 on."""
    ends = np.cumsum([phase.seconds for phase in phases]).tolist()
    return [Window(phase.name, end - phase.seconds, end) for phase, end in zip(phases, ends, strict=True)]


def poisson_arrivals(phases: Sequence[Phase], seed: int) -> Times:
    """Seconds from the run's start at which requests are due: float64 [k], ascending.

    A Poisson process of a constant rate is a Poisson number of times spread evenly at random.
    """
    random = np.random.default_rng(seed)
    due = [
        window.start_s
        + np.sort(random.uniform(0, phase.seconds, random.poisson(phase.rate_rps * phase.seconds)))
        for phase, window in zip(phases, windows(phases), strict=True)
    ]
    return np.concatenate(due) if due else np.empty(0)
