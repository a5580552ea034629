"""Scenario `hostile`: a steady rate of polite requests while others dawdle, or (see `costly`) ask much."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np

from loadtests.aftermath import left_behind
from loadtests.arrivals import Phase, poisson_arrivals, windows
from loadtests.bodies import make_call, make_calls
from loadtests.costly import costly_calls
from loadtests.hostile import Bait, Hostility, be_hostile
from loadtests.loads import OpenLoop
from loadtests.mix import Kind
from loadtests.run import WARM_UP, Result, Setup, check, run

CALM, HOSTILE, AFTER = "calm", "hostile", "after"
_NICENESS: Final = 5
"""Of hostile clients, who have machines of their own elsewhere: here polite ones go before them."""


def hostile(setup: Setup, hostility: Hostility, name: str = "hostile") -> Result:
    """Measure polite requests before, during and after; hostile ones stream where the mix has streams.

    Raises:
        ServiceAway: the service has no metrics to say what it still holds.
        WorkerDied: a process of the generator did.
        ValueError: there are no scenes.
    """
    before = Phase(WARM_UP, setup.warm_up_s, setup.rate_rps)
    phases = [before, *(Phase(name, setup.seconds, setup.rate_rps) for name in (CALM, HOSTILE, AFTER))]
    load = _alike(setup, phases)
    bait = make_bait(setup, hostility)
    begins = next(window for window in windows(phases) if window.name == HOSTILE)
    ends: dict[str, dict[str, int]] = {}

    def meanwhile(starts_at: float) -> None:
        time.sleep(max(0.0, starts_at + begins.start_s - time.monotonic()))
        ends.update(attack(setup, hostility, bait, begins.seconds))

    ran = run(load, phases, setup, meanwhile)
    held = left_behind(setup.target)
    parts = {name: ran.summary(setup.goal_s, name) for name in (CALM, HOSTILE, AFTER)}
    overall = ran.summary(setup.goal_s, CALM, AFTER)
    faults = check(parts[CALM], setup)
    if failed := overall.count("failed"):
        faults.append(f"{failed} polite requests failed: {overall.problems()}")
    if any(held.values()):
        faults.append(f"the service still holds what nobody waits for: {held}")
    before_s, during_s = (parts[name].latencies().percentile_s("p95") for name in (CALM, HOSTILE))
    ratio = during_s / before_s if during_s is not None and before_s else None
    return Result(
        name,
        overall,
        parts,
        tuple(faults),
        {"hostile": {"clients": ends, "polite_p95_ratio": ratio, "left_behind": held}},
        (
            *(f"{name.replace('_', ' ')}: {_told(ended)}" for name, ended in ends.items()),
            "no p95 to compare" if ratio is None else f"polite p95 meanwhile: {ratio:.2f} times that before",
            f"held afterwards: {held}",
        ),
        ran.exchanges,
    )


def _alike(setup: Setup, phases: Sequence[Phase]) -> OpenLoop:
    """Requests that come alike in all phases but the warm-up: as many, at the same times, of the same kinds.

    By chance one phase would have more second looks than another, or more at once, and p95 rests on few.
    """
    warm_up, *measured = windows(phases)
    early_s = poisson_arrivals(phases[:1], setup.seed)
    due_s = poisson_arrivals(phases[1:2], setup.seed + 1)
    early = setup.mix.kinds(len(early_s), setup.seed)
    each = min(len(due_s), max(1, setup.distinct // len(measured)))
    kinds = setup.mix.kinds(each, setup.seed + 1)
    calls = make_calls(setup.scenes, [*early, *kinds * len(measured)], setup.seed)
    again = [
        calls[len(early) + part * each + place % each]
        for part in range(len(measured))
        for place in range(len(due_s))
    ]
    return OpenLoop(
        np.concatenate([warm_up.start_s + early_s, *(window.start_s + due_s for window in measured)]),
        (*calls[: len(early)], *again),
    )


def make_bait(setup: Setup, hostility: Hostility) -> Bait:
    """What hostile clients send; made before a run begins."""
    scenes, seed = setup.scenes[:1], setup.seed
    plan = make_call(Kind("think", max(setup.mix.draws), stream=setup.mix.stream > 0), scenes, seed)
    dear = costly_calls(make_call(Kind("direct", 1), scenes, seed)) if hostility.costly else []
    labels = [make_call(Kind("label", 1), scenes, seed)] if hostility.labelling else []
    return Bait(plan, dear, labels)


def attack(setup: Setup, hostility: Hostility, bait: Bait, seconds: float) -> dict[str, dict[str, int]]:
    """How hostile clients ended, in a thread of less weight than this one; see `be_hostile`."""

    def run_nicely() -> dict[str, dict[str, int]]:
        os.nice(_NICENESS)
        return asyncio.run(be_hostile(setup.target, bait, hostility, seconds))

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(run_nicely).result()


def _told(ended: dict[str, int]) -> str:
    return ", ".join(f"{count} x {end}" for end, count in ended.items())
