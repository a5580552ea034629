"""A turn begins when what ran before has left the processors."""

from __future__ import annotations

import subprocess
import sys
from itertools import count, repeat

import pytest

from looktwice.model.bench.quiet import wait_until_quiet
from looktwice.model.engines.torch.threads import CpuTimes, cpu_times

SPINS = """
import time
until = time.monotonic() + 1.0
print("begun", flush=True)
while time.monotonic() < until:
    pass
"""


@pytest.mark.skipif(cpu_times() is None, reason="the kernel does not tell")
def test_a_process_that_spins_behind_its_answer_is_waited_for() -> None:
    with subprocess.Popen([sys.executable, "-c", SPINS], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        quiet = wait_until_quiet()
        # A machine that is busy with other things as well is given up on, but never before the process ended.
        assert process.poll() is not None or not quiet


def test_a_machine_that_is_always_busy_is_not_waited_for_forever() -> None:
    busy = (CpuTimes(float(second), 2) for second in count())
    slept: list[float] = []
    assert not wait_until_quiet(lambda: next(busy), slept.append)
    assert sum(slept) == 3.0


def test_nothing_is_waited_for_where_the_kernel_does_not_tell() -> None:
    slept: list[float] = []
    assert not wait_until_quiet(lambda: None, slept.append)
    assert not slept


def test_a_quiet_machine_costs_one_look() -> None:
    slept: list[float] = []
    quiet = repeat(CpuTimes(7.0, 2))
    assert wait_until_quiet(lambda: next(quiet), slept.append)
    assert slept == [0.25]
