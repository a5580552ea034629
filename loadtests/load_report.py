"""What a run found, for scripts and for the terminal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from looktwice.loadtests.accounting import PERCENTILES, Latencies, Summary
from looktwice.loadtests.exchange import BRANCHES, OUTCOMES
from looktwice.loadtests.load_run import Result, Setup


@dataclass(frozen=True)
class LoadReport:
    """A result with all that it depends on.

    Attributes:
        began: date and time, ISO 8601.
        client, service, versions: see `looktwice.loadtests.environment`.
    """

    setup: Setup
    result: Result
    began: str
    client: dict[str, Any]
    service: dict[str, Any]
    versions: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """The figures that stand for the whole at the top; see `Summary.to_json` for what scripts rely on."""
        result = self.result
        return {
            "scenario": result.scenario,
            "valid": result.valid,
            "faults": list(result.faults),
            **result.overall.to_json(),
            **result.extra,
            "phases": {name: part.to_json() for name, part in result.phases.items()},
            "setup": self.setup.to_json(),
            "began": self.began,
            "client": self.client,
            "service": self.service,
            "versions": self.versions,
        }

    def __str__(self) -> str:
        result = self.result
        lines = [
            f"{result.scenario}: {result.overall.window.name}",
            *result.findings,
            "",
            figures(result.overall),
        ]
        for name, part in result.phases.items():
            lines += ["", name, figures(part)]
        if result.faults:
            lines += ["", "NOT VALID", *(f"  {fault}" for fault in result.faults)]
        return "\n".join(lines)


def figures(summary: Summary) -> str:
    """One window's figures as text."""
    lines = [
        f"offered {summary.offered_rps:.2f}/s, achieved {summary.achieved_rps:.2f}/s "
        f"({summary.achieved_share:.1%}), goodput {summary.goodput:.1%} within {summary.goal_s * 1e3:.0f} ms "
        "or their deadline",
        f"{len(summary.exchanges)} requests: "
        + ", ".join(f"{summary.count(name)} {name}" for name in OUTCOMES),
        *(f"  {count} x {problem}" for problem, count in summary.problems().items()),
        f"{'ms':<12}" + "".join(f"{name:>9}" for name in (*PERCENTILES, "count")),
    ]
    for row, latencies in latency_rows(summary).items():
        if len(latencies):
            times = [f"{(latencies.percentile_s(name) or 0) * 1e3:.1f}" for name in PERCENTILES]
            lines.append(f"{row:<12}" + "".join(f"{time:>9}" for time in (*times, len(latencies))))
    return "\n".join(lines)


def latency_rows(summary: Summary) -> dict[str, Latencies]:
    """Of all answers, of each branch, and how late requests were sent."""
    branches = {branch: summary.latencies(branch) for branch in BRANCHES}
    return {"all": summary.latencies()} | branches | {"sent late by": summary.lags()}
