"""How many CPU threads an engine may use, and how many of them have a core to themselves."""

from __future__ import annotations

import functools
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import torch

_CGROUP: Final = Path("/sys/fs/cgroup")
_STAT: Final = Path("/proc/stat")
_EVERY_S: Final = 1.0
_WAIT_S: Final = 5.0
"""A core that was in use must be free for so long before a thread is put on it again."""
_SPARE: Final = 0.25
"""Of a core, that others may use while a thread of ours still counts as having it."""


def granted_cpus(cgroup: Path = _CGROUP) -> int | None:
    """CPUs that this process' control group grants, rounded up; None where it sets no limit.

    Args:
        cgroup: where its files are: ``cpu.max`` (version 2), or ``cpu/cpu.cfs_quota_us`` and
            ``cpu/cpu.cfs_period_us`` (version 1).
    """
    try:
        if (limit := cgroup / "cpu.max").exists():
            quota, period = limit.read_text().split()
        else:
            quota, period = (
                (cgroup / "cpu" / f"cpu.cfs_{what}_us").read_text() for what in ("quota", "period")
            )
        share = float(quota) / float(period)
    except (OSError, ValueError):  # ValueError: "max"
        return None
    return math.ceil(share) if share > 0 else None


def fit_threads() -> None:
    """Let torch's operations on this thread use as many threads as CPUs are granted.

    torch counts the cores of the machine; where a container is granted fewer, its threads wait for each other
    until the next period of its quota. ``OMP_NUM_THREADS`` overrides it, as everywhere.
    """
    most, granted = _threads_at_first(), granted_cpus()
    if granted is not None and "OMP_NUM_THREADS" not in os.environ:
        most = min(granted, most)
    torch.set_num_threads(most)


@functools.cache
def _threads_at_first() -> int:
    """What torch used before any engine here left cores to others.

    A new thread begins with what was set last, on whichever thread that was.
    """
    return torch.get_num_threads()


class CpuTimes(NamedTuple):
    """Seconds that processors worked for others, or were kept from working for anybody here, since some time
    long ago; and how many processors there are."""

    others_s: float
    processors: int


def cpu_times(stat: Path = _STAT) -> CpuTimes | None:
    """From the kernel's count of all processors, less what this process used; None where there is none."""
    try:
        lines = stat.read_text().splitlines()
    except OSError:
        return None
    user, nice, system, _, _, irq, softirq, stolen, *_ = map(int, lines[0].split()[1:])
    ticks = user + nice + system + irq + softirq + stolen
    own = os.times()
    processors = sum(line.startswith("cpu") for line in lines) - 1
    return CpuTimes(ticks / os.sysconf("SC_CLK_TCK") - own.user - own.system, processors)


class FreeCores:
    """How many threads to use: as many as have a core to themselves.

    The threads of an operation wait for the last of them, and a pass is hundreds of operations. Where
    something else wants one of two cores (a planner on the same machine, a neighbour on the same host), two
    threads take three to ten times as long as one. Only what others do while there is work here counts:
    whoever computes, asks and waits leaves all cores to the answer.

    Args:
        most: threads that may be used.
        read: what the machine's processors did.
        clock: seconds, ever growing.

    Attributes:
        threads: to be used now.
    """

    def __init__(
        self,
        most: int,
        read: Callable[[], CpuTimes | None] = cpu_times,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.threads = self._most = most
        # Where there is no choice nothing needs to be known.
        self._read, self._clock = read if most > 1 else lambda: None, clock
        self._before, self._since_s, self._crowded_s = self._read(), clock(), -math.inf
        self._worked_s = self._others_s = 0.0

    def rest(self) -> None:
        """There is no work from now on: count what others did while there was."""
        before, since_s = self._before, self._since_s
        self.resume()
        if before is not None and self._before is not None:
            self._worked_s += self._since_s - since_s
            self._others_s += self._before.others_s - before.others_s

    def resume(self) -> None:
        """There is work again: what others did until now does not count."""
        self._before, self._since_s = self._read(), self._clock()

    def look(self) -> int:
        """``threads``, after a look at the machine where there was work for a while since the last one."""
        now_s = self._clock()
        if self._worked_s + now_s - self._since_s < _EVERY_S:
            return self.threads
        self.rest()
        if self._before is None or not self._worked_s:
            return self.threads
        free = self._before.processors - self._others_s / self._worked_s
        self._worked_s = self._others_s = 0.0
        fitting = min(self._most, max(1, math.floor(free + _SPARE)))
        if fitting <= self.threads and fitting < self._most:
            self._crowded_s = now_s
        if fitting < self.threads or now_s - self._crowded_s >= _WAIT_S:
            self.threads = fitting
        return self.threads
