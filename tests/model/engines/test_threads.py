from __future__ import annotations

from pathlib import Path

import pytest
import torch

from model.engines.torch import threads
from model.engines.torch.worker import Worker


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


def test_the_engines_thread_uses_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(threads, "granted_cpus", lambda: 1)
    worker = Worker("fitted")
    try:
        worker.submit(threads.fit_threads).result()
        assert worker.submit(torch.get_num_threads).result() == 1
    finally:
        worker.close()
