from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from looktwice.model.engines.torch import threads
from looktwice.model.engines.torch.threads import CpuTimes, FreeCores, cpu_times
from looktwice.model.engines.torch.worker import Worker


@pytest.mark.parametrize(
    ("told", "granted"),
    [
        ("200000 100000\n", 2),
        ("150000 100000\n", 2),
        ("50000 100000\n", 1),
        ("max 100000\n", None),
        ("", None),
    ],
)
def test_what_a_control_group_grants(tmp_path: Path, told: str, granted: int | None) -> None:
    (tmp_path / "cpu.max").write_text(told)
    assert threads.granted_cpus(tmp_path) == granted


@pytest.mark.parametrize(("quota", "granted"), [("300000", 3), ("-1", None)])
def test_the_same_in_version_1(tmp_path: Path, quota: str, granted: int | None) -> None:
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text(quota)
    (tmp_path / "cpu" / "cpu.cfs_period_us").write_text("100000")
    assert threads.granted_cpus(tmp_path) == granted


def test_without_control_groups_nothing_is_known(tmp_path: Path) -> None:
    assert threads.granted_cpus(tmp_path) is None


@contextmanager
def fitted(name: str) -> Iterator[Worker]:
    worker = Worker(name)
    try:
        worker.submit(threads.fit_threads).result()
        yield worker
    finally:
        worker.close()


def test_the_engines_thread_uses_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(threads, "granted_cpus", lambda: 1)
    with fitted("fitted") as worker:
        assert worker.submit(torch.get_num_threads).result() == 1


def test_an_engine_is_not_held_back_by_what_another_left_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "granted_cpus", lambda: None)
    monkeypatch.setattr(threads, "_threads_at_first", lambda: 3)
    with fitted("first") as first:
        first.submit(lambda: torch.set_num_threads(1)).result()
        with fitted("later") as later:
            assert later.submit(torch.get_num_threads).result() == 3


class Machine:
    """Eight processors, so many of them in use by others, and a clock."""

    def __init__(self, most: int = 8) -> None:
        self.now_s, self.others_s, self.known = 0.0, 0.0, True
        self.cores = FreeCores(most, self.read, lambda: self.now_s)

    def read(self) -> CpuTimes | None:
        return CpuTimes(self.others_s, 8) if self.known else None

    def pass_by(self, seconds: float, others: float) -> None:
        self.now_s += seconds
        self.others_s += seconds * others

    def after(self, seconds: float, others: float) -> int:
        self.pass_by(seconds, others)
        return self.cores.look()


def test_a_core_that_others_want_is_left_to_them_at_once() -> None:
    machine = Machine()
    assert machine.after(1, others=0.2) == 8
    assert machine.after(1, others=0.5) == 7
    assert machine.after(1, others=3.0) == 5
    assert machine.after(1, others=20.0) == 1


def test_a_core_is_taken_again_when_it_was_free_for_a_while() -> None:
    machine = Machine()
    assert machine.after(1, others=6.0) == 2
    assert [machine.after(1, others=0.0) for _ in range(5)] == [2, 2, 2, 2, 8]
    assert machine.after(1, others=6.0) == 2
    assert [machine.after(1, others=other) for other in (0.0, 0.0, 6.0, 0.0, 0.0, 0.0, 0.0)] == [2] * 7
    assert machine.after(1, others=0.0) == 8


def test_no_more_are_used_than_are_granted() -> None:
    machine = Machine(most=2)
    assert machine.after(1, others=5.0) == 2
    assert machine.after(1, others=6.9) == 1
    assert [machine.after(2, others=5.0) for _ in range(3)] == [1, 1, 2]


def test_what_others_do_while_there_is_no_work_changes_nothing() -> None:
    machine = Machine()
    for _ in range(10):
        machine.cores.rest()
        machine.pass_by(0.8, others=8.0)
        machine.cores.resume()
        assert machine.after(0.3, others=0.0) == 8


def test_of_short_spells_of_work_enough_are_counted_together() -> None:
    machine = Machine()
    threads = []
    for _ in range(4):
        threads.append(machine.after(0.3, others=6.0))
        machine.cores.rest()
        machine.pass_by(10.0, others=0.0)
        machine.cores.resume()
    assert threads == [8, 8, 8, 2]


def test_what_is_not_known_changes_nothing() -> None:
    machine = Machine()
    assert machine.after(0.5, others=8.0) == 8, "looked at a moment ago"
    machine.known = False
    assert machine.after(1, others=8.0) == 8
    assert machine.after(1, others=8.0) == 8


def test_what_the_kernel_tells(tmp_path: Path) -> None:
    stat = tmp_path / "stat"
    stat.write_text("cpu  100 20 30 4000 50 6 7 80 9 0\ncpu0 1 1\ncpu1 1 1\nintr 5\nctxt 6\n")
    own = os.times()
    told = cpu_times(stat)
    assert told is not None
    assert told.processors == 2
    assert told.others_s == pytest.approx(243 / os.sysconf("SC_CLK_TCK") - own.user - own.system, abs=0.5)
    assert cpu_times(tmp_path / "none") is None


@pytest.fixture
def crowd() -> Iterator[None]:
    """As many processes that never rest as there are processors."""
    everyone = [subprocess.Popen([sys.executable, "-c", "while 1: 0"]) for _ in range(os.cpu_count() or 1)]
    yield
    for each in everyone:
        each.kill()
        each.wait()


@pytest.mark.skipif(cpu_times() is None, reason="this system does not tell what processors do")
@pytest.mark.usefixtures("crowd")
def test_on_a_crowded_machine_one_thread_is_used() -> None:
    cores = FreeCores(os.cpu_count() or 1)
    for _ in range(20):
        time.sleep(1.1)
        if cores.look() == 1:
            return
    raise AssertionError(cores.threads)
