"""Scenario `burst`: a steady rate, then many times as much for a while, then the steady rate again."""

from __future__ import annotations

from loadtests.arrivals import Phase, poisson_arrivals
from loadtests.bodies import make_calls
from loadtests.loads import OpenLoop
from loadtests.run import WARM_UP, Result, Setup, check, needed, run

UNLOADED, BURST, AFTER = "unloaded", "burst", "after"


def burst(setup: Setup, factor: float, burst_s: float) -> Result:
    """Offer ``factor`` times the rate for ``burst_s``; raises `WorkerDied`, `ValueError`."""
    phases = [
        Phase(WARM_UP, setup.warm_up_s, setup.rate_rps),
        Phase(UNLOADED, setup.seconds, setup.rate_rps),
        Phase(BURST, burst_s, factor * setup.rate_rps),
        Phase(AFTER, setup.seconds, setup.rate_rps),
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
