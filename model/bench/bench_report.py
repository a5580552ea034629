"""What the bench found, for people and scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from looktwice.model.bench.bench_run import BenchRow, Deadlines, PlannerLatency
from looktwice.model.bench.roofline import Machine, PlanCost
from looktwice.model.driving.columns import aligned, interval_cell


@dataclass(frozen=True)
class Roofline:
    """One plan of the torch engine against the machine: ``scenes`` at once, ``n`` draws each."""

    machine: Machine
    scenes: int
    n: int
    work: PlanCost
    least_s: float
    measured_s: float

    @property
    def share(self) -> float:
        """Of the time that arithmetic and memory need at least."""
        return self.least_s / self.measured_s


@dataclass(frozen=True)
class BenchReport:
    """All figures of a run.

    Attributes:
        rows: engines at workloads.
        shortcuts: the torch engine with more and more of its shortcuts, in order.
        rooflines: of the torch engine, adaptive.
        planners: the torch engine asked again for the same pictures.
        deadlines: the torch engine at a steady load.
    """

    rows: tuple[BenchRow, ...]
    shortcuts: tuple[BenchRow, ...]
    rooflines: tuple[Roofline, ...]
    planners: tuple[PlannerLatency, ...] = ()
    deadlines: tuple[Deadlines, ...] = ()

    def ratios(self) -> list[dict[str, Any]]:
        """Latency and plans per second against ours at the same workload; above 1 is slower."""
        ours = {_load(row): row for row in self.rows if row.engine == "torch"}
        return [
            {
                "engine": row.engine,
                "scenes": row.scenes,
                "n": row.n,
                "thinking": row.thinking,
                "latency_p50": row.latency_p50_s / ours[_load(row)].latency_p50_s,
                "plans_per_s": ours[_load(row)].plans_per_s / row.plans_per_s,
            }
            for row in self.rows
            if row.engine != "torch" and _load(row) in ours
        ]

    def to_json(self) -> dict[str, Any]:
        """For scripts; ``rows`` and ``roofline`` are a contract."""
        return {
            "rows": [asdict(row) for row in self.rows],
            "ratios": self.ratios(),
            "shortcuts": [asdict(row) for row in self.shortcuts],
            "planner": [asdict(each) | {"ratio": each.ratio} for each in self.planners],
            "deadlines": [asdict(each) for each in self.deadlines],
            "roofline": {
                "machine": asdict(self.rooflines[0].machine) if self.rooflines else None,
                "plans": [
                    {
                        "scenes": each.scenes,
                        "n": each.n,
                        "flops": each.work.flops,
                        "bytes": each.work.bytes,
                        "least_s": each.least_s,
                        "measured_s": each.measured_s,
                        "share": each.share,
                    }
                    for each in self.rooflines
                ],
            },
        }

    def __str__(self) -> str:
        parts = [_table(self.rows)]
        if others := self.ratios():
            lines = [["against torch", "", "", "latency", "plans/s"]] + [
                [
                    each["engine"],
                    f"{each['scenes']} x {each['n']}",
                    each["thinking"],
                    f"{each['latency_p50']:.1f}",
                    f"{each['plans_per_s']:.1f}",
                ]
                for each in others
            ]
            parts.append("\n".join(aligned(lines, left=3)))
        if self.shortcuts:
            parts.append("shortcuts, one after the other\n" + _table(self.shortcuts))
        for planner in self.planners:
            parts.append(
                f"a planner's next request, n = {planner.n}: {planner.next_p50_s * 1e3:.0f} ms, "
                f"{planner.ratio:.2f} of the {planner.cold_p50_s * 1e3:.0f} ms of the first"
            )
        for asked in self.deadlines:
            parts.append(
                f"{asked.requests} requests of {asked.n} draws, {asked.per_s:.1f} a second: "
                f"{asked.honoured:.1%} within {asked.deadline_ms} ms; "
                f"p50 {asked.latency_p50_s * 1e3:.0f} ms, p99 {asked.latency_p99_s * 1e3:.0f} ms"
            )
        for each in self.rooflines:
            machine = each.machine
            parts.append(
                f"{each.scenes} x {each.n}: a plan takes {each.work.flops / 1e9:.1f} GFLOP and moves "
                f"{each.work.bytes / 1e6:.0f} MB; at {machine.flops_per_s / 1e9:.0f} GFLOP/s "
                f"({machine.dtype}) and {machine.copy_bytes_per_s / 1e9:.1f} GB/s that is "
                f"{each.least_s * 1e3:.1f} ms, {each.share:.0%} of what was measured"
            )
        return "\n\n".join(parts)


def _load(row: BenchRow) -> tuple[int, int, str, float]:
    return row.scenes, row.n, row.thinking, row.temperature


def _rows(row: BenchRow) -> str:
    """Rows that were fed, of those that a row for every draw would have come to."""
    fan_out = row.counts.get("fan_out_row_passes")
    return f"{row.counts['row_passes'] / fan_out:.2f}" if fan_out else "-"


_TITLES: Final = (
    *("engine", "load", "thinking", "p50 ms", "p95 ms", "plans/s", "spread", "tokens/s", "passes"),
    *("tokens", "forced", "valid", "rows", "MiB"),
)


def _table(rows: Sequence[BenchRow]) -> str:
    lines = [
        (
            row.engine,
            f"{row.scenes} x {row.n}",
            row.thinking,
            f"{row.latency_p50_s * 1e3:.0f}",
            f"{row.latency_p95_s * 1e3:.0f}",
            f"{row.plans_per_s:.2f}",
            interval_cell(row.plans_per_s_spread, "{:.2f}"),
            f"{row.tokens_per_s:.0f}",
            f"{row.passes_per_response:.1f}",
            f"{row.tokens_per_response:.1f}",
            f"{row.forced_share:.0%}",
            f"{row.valid_share:.0%}",
            _rows(row),
            f"{row.peak_bytes / 2**20:.0f}",
        )
        for row in rows
    ]
    return "\n".join(aligned([_TITLES, *lines], left=3))
