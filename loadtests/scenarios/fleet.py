"""Scenario `fleet`: planners that ask at a fixed rate and wait for their answers, closed loop."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from loadtests.drives import make_drives
from loadtests.loads import fleet as make_fleet
from loadtests.run import Result, Setup, check, run
from loadtests.scenarios.poisson import MEASURED, steady_phases

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
