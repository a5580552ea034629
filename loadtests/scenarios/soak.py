"""Scenario `soak`: a long run at a share of the knee, with an eye on the server's memory."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from loadtests.accounting import Summary, summarise
from loadtests.arrivals import Window
from loadtests.memory import Growth, MemoryWatch, growth
from loadtests.run import Result, Setup, check
from loadtests.scenarios.poisson import MEASURED, run_steady

_READINGS: Final = 500
_LEAST_PAUSE_S: Final = 0.2
_EDGE: Final = 0.1
"""Share of the run that stands for its beginning, and for its end."""


def soak(setup: Setup, knee_rps: float, share: float, pid: int, growth_limit: float = 0.05) -> Result:
    """Offer ``share`` of ``knee_rps`` for the setup's time, and watch the memory of process ``pid``.

    Not valid where memory could not be read, or grew by more than ``growth_limit`` over the second half.

    Raises:
        ValueError: there is no such process here.
        WorkerDied: a process of the generator did.
    """
    setup = replace(setup, rate_rps=share * knee_rps)
    every_s = max(_LEAST_PAUSE_S, (setup.warm_up_s + setup.seconds) / _READINGS)
    with MemoryWatch(pid, every_s) as watch:
        ran = run_steady(setup)
    overall = ran.summary(setup.goal_s, MEASURED)
    window = overall.window
    readings = [each for each in watch.readings(ran.starts_at) if window.start_s <= each.at_s <= window.end_s]
    grown = growth(readings)
    first, last = _edges(overall)
    return Result(
        "soak",
        overall,
        {first.window.name: first, last.window.name: last},
        (*check(overall, setup), *_memory_faults(grown, growth_limit)),
        {
            "soak": {"knee_rps": knee_rps, "share": share},
            "memory": {"pid": pid, "readings": [(each.at_s, each.rss_bytes) for each in readings]}
            | (grown.to_json() if grown else {}),
        },
        (
            f"{share:.0%} of the knee at {knee_rps:.2f} requests a second",
            "the server's memory could not be read"
            if grown is None
            else f"the server's memory went from {grown.first_bytes / 2**20:.1f} to "
            f"{grown.last_bytes / 2**20:.1f} MiB "
            f"over {setup.seconds / 60:.1f} minutes, {grown.late:+.1%} of it in the second half",
        ),
        ran.exchanges,
    )


def _memory_faults(grown: Growth | None, limit: float) -> list[str]:
    if grown is None:
        return ["the server's memory could not be read"]
    if grown.late > limit:
        return [f"the server's memory grew by {grown.late:.1%} in the second half; {limit:.0%} is allowed"]
    return []


def _edges(overall: Summary) -> tuple[Summary, Summary]:
    whole = overall.window
    edge_s = whole.seconds * _EDGE
    return (
        summarise(
            overall.exchanges, Window("first tenth", whole.start_s, whole.start_s + edge_s), overall.goal_s
        ),
        summarise(overall.exchanges, Window("last tenth", whole.end_s - edge_s, whole.end_s), overall.goal_s),
    )
