"""Scenario `sweep`: steady rates, one after the other, to the knee."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from looktwice.loadtests.accounting import LEAST_ACHIEVED, Summary
from looktwice.loadtests.bodies import make_calls
from looktwice.loadtests.exchange import Exchange
from looktwice.loadtests.load_run import Result, Setup, check, run
from looktwice.loadtests.loads import OpenLoop, poisson_arrivals
from looktwice.loadtests.scenarios.steady import MEASURED, steady_phases


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


LEAST_GOODPUT: Final = 0.95
"""At a rate that is sustained: 95 of 100 requests within their goal."""
LEAST_REQUESTS: Final = 60
"""At each rate, on average: fewer say nothing about 95 of 100, so low rates take longer."""


@dataclass(frozen=True)
class Point:
    """What was found at one rate."""

    rate_rps: float
    summary: Summary

    @property
    def sustained(self) -> bool:
        """Whether the service kept up, and in time."""
        return self.summary.achieved_share >= LEAST_ACHIEVED and self.summary.goodput >= LEAST_GOODPUT

    def to_json(self) -> dict[str, Any]:
        """For scripts."""
        return {"rate_rps": self.rate_rps, "sustained": self.sustained} | self.summary.to_json()


def sweep(setup: Setup, search: KneeSearch) -> Result:
    """Find the highest rate that is sustained; raises `GeneratorDied`, `ValueError`."""
    setup.tell(f"writing {setup.distinct} requests")
    calls = tuple(make_calls(setup.scenes, setup.mix.kinds(setup.distinct, setup.seed), setup.seed))
    points: dict[float, Point] = {}
    exchanges: tuple[Exchange, ...] = ()
    faults: list[str] = []
    sent = 0
    while (
        rate_rps := search.next_rps({rate: point.sustained for rate, point in points.items()})
    ) is not None:
        seconds = max(setup.seconds, LEAST_REQUESTS / rate_rps)
        step = replace(setup, rate_rps=rate_rps, seconds=seconds)
        phases = steady_phases(step)
        due_s = poisson_arrivals(phases, setup.seed + len(points))
        ran = run(OpenLoop(due_s, calls, sent), phases, step)
        sent += len(due_s)
        point = points[rate_rps] = Point(rate_rps, ran.summary(setup.goal_s, MEASURED))
        setup.tell(_line(point))
        if point.sustained:
            faults += check(point.summary, setup)
    knee = knee_rps({rate: point.sustained for rate, point in points.items()})
    if knee is None:
        faults.append("no rate was sustained, down to the lowest one that was tried")
    stands = points[min(points) if knee is None else knee]
    ordered = [points[rate] for rate in sorted(points)]
    return Result(
        "sweep",
        stands.summary,
        {},
        tuple(faults),
        {"knee_rps": knee, "points": [point.to_json() for point in ordered]},
        (
            f"the knee is at {knee:.2f} requests a second" if knee else "there is no knee",
            f"sustained: {LEAST_ACHIEVED:.0%} of what was offered is achieved, {LEAST_GOODPUT:.0%} in time",
            *map(_line, ordered),
        ),
        exchanges,
    )


def _line(point: Point) -> str:
    latencies = point.summary.latencies()
    p50, p99 = latencies.percentile_s("p50"), latencies.percentile_s("p99")
    times = "no answers" if p50 is None or p99 is None else f"p50 {p50 * 1e3:.0f} ms, p99 {p99 * 1e3:.0f} ms"
    return (
        f"{point.rate_rps:.2f} a second: {point.summary.achieved_share:.1%} achieved, "
        f"{point.summary.goodput:.1%} in time, {times}: {'sustained' if point.sustained else 'too much'}"
    )
