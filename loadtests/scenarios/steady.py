"""Scenarios of polite load: `poisson`, `burst`, `fleet` and `soak`."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from looktwice.loadtests.accounting import Summary, summarise
from looktwice.loadtests.bodies import make_calls, make_drives
from looktwice.loadtests.load_run import WARM_UP, Ran, Result, Setup, check, needed, run
from looktwice.loadtests.loads import LoadPhase, OpenLoop, Window, poisson_arrivals
from looktwice.loadtests.loads import fleet as make_fleet
from looktwice.loadtests.memory import Growth, MemoryWatch, growth

MEASURED = "measured"


def poisson(setup: Setup) -> Result:
    """Offer the mix at a steady rate; raises `GeneratorDied`, `ValueError`."""
    ran = run_steady(setup)
    overall = ran.summary(setup.goal_s, MEASURED)
    return Result("poisson", overall, {}, tuple(check(overall, setup)), exchanges=ran.exchanges)


def run_steady(setup: Setup) -> Ran:
    """Warm up and measure at one rate."""
    phases = steady_phases(setup)
    calls = tuple(make_calls(setup.scenes, setup.mix.kinds(needed(phases, setup), setup.seed), setup.seed))
    return run(OpenLoop(poisson_arrivals(phases, setup.seed), calls), phases, setup)


def steady_phases(setup: Setup) -> list[LoadPhase]:
    """A warm-up and what is measured, both at the same rate."""
    return [
        LoadPhase(WARM_UP, setup.warm_up_s, setup.rate_rps),
        LoadPhase(MEASURED, setup.seconds, setup.rate_rps),
    ]


UNLOADED, BURST, AFTER = "unloaded", "burst", "after"


def burst(setup: Setup, factor: float, burst_s: float) -> Result:
    """Offer ``factor`` times the rate for ``burst_s``; raises `GeneratorDied`, `ValueError`."""
    phases = [
        LoadPhase(WARM_UP, setup.warm_up_s, setup.rate_rps),
        LoadPhase(UNLOADED, setup.seconds, setup.rate_rps),
        LoadPhase(BURST, burst_s, factor * setup.rate_rps),
        LoadPhase(AFTER, setup.seconds, setup.rate_rps),
    ]
    calls = tuple(make_calls(setup.scenes, setup.mix.kinds(needed(phases, setup), setup.seed), setup.seed))
    ran = run(OpenLoop(poisson_arrivals(phases, setup.seed), calls), phases, setup)
    parts = {name: ran.summary(setup.goal_s, name) for name in (UNLOADED, BURST, AFTER)}
    overall = ran.summary(setup.goal_s, UNLOADED, AFTER)
    p95 = {name: part.latencies().percentile_s("p95") for name, part in parts.items()}
    before_s, during_s = p95[UNLOADED], p95[BURST]
    ratio = during_s / before_s if during_s is not None and before_s else None
    faults = check(parts[UNLOADED], setup)
    if failed := overall.count("failed"):
        faults.append(f"{failed} requests failed, which is not how a service refuses: {overall.problems()}")
    rejected = parts[BURST].count("rejected")
    return Result(
        "burst",
        overall,
        parts,
        tuple(faults),
        {
            "burst": {
                "factor": factor,
                "seconds": burst_s,
                "unloaded_p95_s": before_s,
                "burst_p95_s": during_s,
                "after_p95_s": p95[AFTER],
                "p95_ratio": ratio,
                "rejected": rejected,
            }
        },
        (
            f"{factor:g} times the rate for {burst_s:g} s: "
            f"{rejected} of {len(parts[BURST].exchanges)} rejected",
            "no p95 to compare"
            if ratio is None
            else f"the p95 of those accepted was {ratio:.1f} times the unloaded one",
        ),
        ran.exchanges,
    )


DRIVE_S: Final = 20.0
"""Of a planner's drive at most; a longer run begins it anew."""


def fleet(setup: Setup, planners: int, hz: float) -> Result:
    """Drive so many planners at ``hz``; the setup's rate does not matter.

    Raises:
        ValueError: there are no planners, or their rate does not fit their histories.
        WorkerDied: a process of the generator did.
    """
    if planners < 1:
        raise ValueError("a fleet has at least one planner")
    setup = replace(setup, rate_rps=planners * hz)
    phases = steady_phases(setup)
    seconds = setup.warm_up_s + setup.seconds
    setup.tell(f"driving {planners} planners ahead")
    drives = make_drives(setup.scenes, setup.mix, planners, hz, min(seconds, DRIVE_S), setup.seed)
    ran = run(make_fleet(drives, hz, seconds, setup.seed), phases, setup)
    overall = ran.summary(setup.goal_s, MEASURED)
    missed = overall.count("missed") / len(overall.exchanges)
    plans_hz = overall.count("answered") / planners / setup.seconds
    return Result(
        "fleet",
        overall,
        {},
        tuple(check(overall, setup)),
        {"fleet": {"planners": planners, "hz": hz, "plans_hz": plans_hz, "missed_share": missed}},
        (
            f"{planners} planners at {hz:g} Hz got {plans_hz:.2f} plans a second each",
            f"{missed:.1%} of the ticks went by while the planner still waited",
        ),
        ran.exchanges,
    )


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
