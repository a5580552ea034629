"""Scenarios `hostile` and `costly`: a steady rate of polite requests while others dawdle or ask much."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from looktwice.loadtests.attacks import COSTLY, Bait, Hostility, be_hostile, costly_calls
from looktwice.loadtests.bad_teacher import BadTeacher
from looktwice.loadtests.bodies import make_call, make_calls
from looktwice.loadtests.environment import left_behind, lines_lost
from looktwice.loadtests.load_run import WARM_UP, Result, Setup, check, run
from looktwice.loadtests.loads import LoadPhase, OpenLoop, poisson_arrivals, windows
from looktwice.loadtests.memory import MemoryWatch
from looktwice.loadtests.mix import RequestKind

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
    before = LoadPhase(WARM_UP, setup.warm_up_s, setup.rate_rps)
    phases = [before, *(LoadPhase(name, setup.seconds, setup.rate_rps) for name in (CALM, HOSTILE, AFTER))]
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


def _alike(setup: Setup, phases: Sequence[LoadPhase]) -> OpenLoop:
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
    plan = make_call(RequestKind("think", max(setup.mix.draws), stream=setup.mix.stream > 0), scenes, seed)
    dear = costly_calls(make_call(RequestKind("direct", 1), scenes, seed)) if hostility.costly else []
    labels = [make_call(RequestKind("label", 1), scenes, seed)] if hostility.labelling else []
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


_WATCH_EVERY_S: Final = 0.2
_LAST_ATTACK_S: Final = 5.0
"""Before the service is told to stop, and again as long after that."""
_LONGEST_STOP_S: Final = 120.0
MAX_P95_RATIO: Final = 1.5
"""Of polite requests during the attack to before: what one request may cost the others."""
MAX_PEAK_BYTES: Final = 1_500_000_000


@dataclass(frozen=True)
class OwnService:
    """A service that was started to be attacked.

    Attributes:
        process: it itself; its log goes where nobody reads it.
        teacher: whom it asks for labels.
        drain_s: after SIGTERM it has so long to end.
    """

    process: subprocess.Popen[bytes]
    teacher: BadTeacher
    drain_s: float


def costly(setup: Setup, own: OwnService | None = None, server_pid: int | None = None) -> Result:
    """Measure polite requests before, during and after; not valid where a goal is missed.

    Args:
        setup: see `Setup`.
        own: the service, where it may be stopped: it gets SIGTERM in the midst of a last attack.
        server_pid: the process whose memory is watched where it is not.

    Raises:
        ServiceAway: the service has no metrics to say what it still holds.
        WorkerDied: a process of the generator did.
        ValueError: there are no scenes, or no such process.
    """
    pid = server_pid if own is None else own.process.pid
    with ExitStack() as stack:
        memory = None if pid is None else stack.enter_context(MemoryWatch(pid, _WATCH_EVERY_S))
        result = hostile(setup, COSTLY, "costly")
        stopped = None if own is None else _stopped(setup, own)
    more: dict[str, Any] = {}
    findings = list(result.findings)
    if memory is not None:
        more["peak_bytes"] = max((each.rss_bytes for each in memory.readings(0.0)), default=0)
        findings.append(f"memory: {more['peak_bytes'] / 1e6:.0f} MB at most")
    if own is not None and stopped is not None:
        more |= stopped | {"drain_s": own.drain_s, "teacher": dict(own.teacher.asked)}
        findings += [
            "the teacher answered: " + ", ".join(f"{way} x {n}" for way, n in more["teacher"].items()),
            f"lines of the log that nobody took: {more['lines_lost']}",
            f"SIGTERM in the midst of it: ended with {more['exit_code']} after {more['stop_s']:.1f} s",
        ]
    told = {"hostile": result.extra["hostile"] | more}
    faults = (*result.faults, *missed_goals(told["hostile"]))
    return replace(result, extra=told, findings=tuple(findings), faults=faults)


def missed_goals(told: Mapping[str, Any]) -> list[str]:
    """What is amiss with a service under attack; empty where all goals are met.

    Args:
        told: `costly`'s figures: ``polite_p95_ratio``, ``peak_bytes`` where memory was watched, and
            ``stop_s``, ``drain_s`` and ``exit_code`` where the service was told to stop.
    """
    missed = []
    ratio, peak_bytes = told["polite_p95_ratio"], told.get("peak_bytes", 0)
    if ratio is None:
        missed.append("no p95 of polite requests to compare; ask for more of them, or for longer")
    elif ratio > MAX_P95_RATIO:
        missed.append(f"polite p95 was {ratio:.2f} times that before; {MAX_P95_RATIO:g} is the goal")
    if peak_bytes > MAX_PEAK_BYTES:
        missed.append(f"memory was {peak_bytes / 1e6:.0f} MB; {MAX_PEAK_BYTES / 1e6:.0f} MB is the goal")
    if "stop_s" in told:
        if told["stop_s"] > told["drain_s"]:
            missed.append(f"it took {told['stop_s']:.1f} s to stop; it drains for {told['drain_s']:g} s")
        if told["exit_code"] != 0:
            missed.append(f"SIGTERM ended it with {told['exit_code']}")
    return missed


def _stopped(setup: Setup, own: OwnService) -> dict[str, Any]:
    """What became of the service, and of its log, when it was told to stop while it was attacked."""
    lost = lines_lost(setup.target)
    bait = make_bait(setup, COSTLY)
    with ThreadPoolExecutor(1) as pool:
        last = pool.submit(attack, setup, COSTLY, bait, 2 * _LAST_ATTACK_S)
        time.sleep(_LAST_ATTACK_S)
        began_s = time.monotonic()
        own.process.send_signal(signal.SIGTERM)
        code = own.process.wait(_LONGEST_STOP_S)
        stop_s = time.monotonic() - began_s
        last.result()
    return {"lines_lost": lost, "exit_code": code, "stop_s": stop_s}
