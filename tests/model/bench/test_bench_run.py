"""Real engines in real processes, on a small untrained checkpoint."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import pytest

from looktwice.model.bench.bench_report import BenchReport, Roofline
from looktwice.model.bench.bench_run import BenchJob, BenchRow, can_do, run
from looktwice.model.bench.contenders import SHORTCUTS
from looktwice.model.bench.process_memory import peak_bytes
from looktwice.model.bench.roofline import Machine, PlanCost
from looktwice.model.bench.workload import Workload
from looktwice.model.bundled import SCENES
from looktwice.model.engines.torch.shortcuts import Shortcuts


def job(checkpoint: Path, *contenders: str, loads: tuple[Workload, ...]) -> BenchJob:
    return BenchJob(contenders, loads, checkpoint, SCENES, repeats=1)


def test_engines_run_side_by_side(untrained_checkpoint: Path) -> None:
    loads = (Workload(2, 2, "adaptive", "cf_vla"), Workload(1, 1, "never", "cf_vla"))
    told: list[str] = []
    names = ("torch", "transformers", "transformers-static")
    rows = run(job(untrained_checkpoint, *names, loads=loads), told.append)
    assert [(row.engine, row.scenes, row.n, row.thinking) for row in rows] == [
        ("torch", 2, 2, "adaptive"),
        ("transformers", 2, 2, "adaptive"),
        ("transformers-static", 2, 2, "adaptive"),
        ("torch", 1, 1, "never"),
    ]
    ours, theirs, static, direct = rows
    assert ours.valid_share == direct.valid_share == 1.0
    assert direct.forced_share > 0.5
    assert theirs.forced_share == static.forced_share == 0.0
    assert theirs.valid_share < 1.0, "an untrained model writes no plans of itself"
    assert direct.passes_per_response < 0.5 * direct.tokens_per_response
    assert ours.counts["fan_out_row_passes"] >= ours.counts["row_passes"] >= ours.counts["scene_passes"] > 0
    assert ours.counts["tokens"] >= ours.counts["kept"] > 0
    assert all(row.peak_bytes > 50 << 20 and row.latency_p95_s >= row.latency_p50_s > 0 for row in rows)
    assert any("round 1 of 1" in line for line in told)


def test_shortcuts_are_switched_by_name(untrained_checkpoint: Path) -> None:
    assert set(SHORTCUTS) == {field.name for field in fields(Shortcuts)}
    names = ("torch+none", "torch+jump")
    none, jump = run(
        job(untrained_checkpoint, *names, loads=(Workload(1, 2, "never", "cf_vla"),)), lambda _: None
    )
    assert none.passes_per_response > 0.95 * none.tokens_per_response
    assert jump.passes_per_response < 0.5 * jump.tokens_per_response


def test_a_contender_that_cannot_start_says_so(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="torch ended early"):
        run(job(tmp_path, "torch", loads=(Workload(1, 1, "never", "cf_vla"),)), lambda _: None)


def test_only_engines_that_know_the_format_are_told_what_to_write() -> None:
    names = ("torch", "vllm-grammar", "vllm", "transformers")
    thinks = Workload(1, 1, "always", "cf_vla")
    imagines = Workload(1, 1, "adaptive", "vla_world", camera="front")
    for told in (thinks, imagines):
        assert [can_do(name, told) for name in names] == [True, True, False, False]
    assert all(can_do(name, Workload(1, 1, "adaptive", "vla_world")) for name in names)


def test_memory_of_this_process_is_known() -> None:
    assert peak_bytes() > 20 << 20
    assert peak_bytes(os.getpid()) > 20 << 20


_PEAKS = """
from looktwice.model.bench.process_memory import forget_peaks, peak_bytes
forget_peaks()
before = peak_bytes()
much = b"x" * (300 << 20)
assert peak_bytes() > before + (200 << 20)
del much
forget_peaks()
assert peak_bytes() < before + (100 << 20)
"""


@pytest.mark.skipif(not os.access("/proc/self/clear_refs", os.W_OK), reason="the kernel keeps peaks")
def test_a_peak_is_of_what_was_done_since() -> None:
    # In a process of its own: other tests may have told theirs to keep what is freed.
    subprocess.run([sys.executable, "-c", _PEAKS], check=True)


def row(engine: str, latency_s: float, plans_per_s: float) -> BenchRow:
    return BenchRow(
        engine,
        1,
        6,
        "adaptive",
        1.0,
        latency_s,
        (latency_s, latency_s),
        latency_s,
        plans_per_s,
        (1, 2),
        9,
        20,
        100,
        1.0,
        0.7,
        1 << 20,
    )


def test_reports_say_how_much_slower_the_others_are() -> None:
    machine = Machine(1e10, 1e12, "bfloat16", "cpu")
    work = PlanCost(2e9, 1e8)
    roofline = Roofline(machine, 1, 6, work, work.seconds(machine), 0.1)
    shared = replace(row("torch", 0.1, 10.0), counts={"row_passes": 63, "fan_out_row_passes": 90})
    report = BenchReport((row("torch", 0.1, 10.0), row("vllm", 0.4, 5.0)), (shared,), (roofline,))
    [ratio] = report.ratios()
    assert ratio["latency_p50"] == pytest.approx(4.0)
    assert ratio["plans_per_s"] == pytest.approx(2.0)
    assert roofline.least_s == pytest.approx(0.01)
    made = json.loads(json.dumps(report.to_json()))
    assert made["roofline"]["plans"][0]["share"] == pytest.approx(0.1)
    assert {"engine", "scenes", "n", "thinking", "latency_p50_s", "latency_p95_s", "plans_per_s"} <= set(
        made["rows"][0]
    )
    assert "vllm" in str(report)
    assert "10%" in str(report)
    assert "0.70" in str(report), "the share of rows that draws that agree leave to be fed"
