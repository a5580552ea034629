"""Scenario `sweep`: steady rates, one after the other, to the knee."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

from loadtests.accounting import LEAST_ACHIEVED, Summary
from loadtests.arrivals import poisson_arrivals
from loadtests.bodies import make_calls
from loadtests.exchange import Exchange
from loadtests.knee import KneeSearch, knee_rps
from loadtests.loads import OpenLoop
from loadtests.run import Result, Setup, check, run
from loadtests.scenarios.poisson import MEASURED, steady_phases

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
    """Find the highest rate that is sustained; raises `WorkerDied`, `ValueError`."""
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
