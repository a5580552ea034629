"""Scenario `poisson`: a steady rate, open loop."""

from __future__ import annotations

from loadtests.arrivals import Phase, poisson_arrivals
from loadtests.bodies import make_calls
from loadtests.loads import OpenLoop
from loadtests.run import WARM_UP, Ran, Result, Setup, check, needed, run

MEASURED = "measured"


def poisson(setup: Setup) -> Result:
    """Offer the mix at a steady rate; raises `WorkerDied`, `ValueError`."""
    ran = run_steady(setup)
    overall = ran.summary(setup.goal_s, MEASURED)
    return Result("poisson", overall, {}, tuple(check(overall, setup)), exchanges=ran.exchanges)


def run_steady(setup: Setup) -> Ran:
    """Warm up and measure at one rate."""
    phases = steady_phases(setup)
    calls = tuple(make_calls(setup.scenes, setup.mix.kinds(needed(phases, setup), setup.seed), setup.seed))
    return run(OpenLoop(poisson_arrivals(phases, setup.seed), calls), phases, setup)


def steady_phases(setup: Setup) -> list[Phase]:
    """A warm-up and what is measured, both at the same rate."""
    return [
        Phase(WARM_UP, setup.warm_up_s, setup.rate_rps),
        Phase(MEASURED, setup.seconds, setup.rate_rps),
    ]
