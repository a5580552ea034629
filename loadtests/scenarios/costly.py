"""Scenario `costly`: a steady rate of polite requests while others send what is dear to serve."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Final

from loadtests.aftermath import lines_lost
from loadtests.bad_teacher import BadTeacher
from loadtests.hostile import COSTLY
from loadtests.memory import MemoryWatch
from loadtests.run import Result, Setup
from loadtests.scenarios.hostile import attack, hostile, make_bait

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
