"""A report as one page that needs nothing from anywhere: tables and plots, no scripts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from loadtests.exchange import OUTCOMES
from loadtests.latencies import PERCENTILES
from loadtests.plots import memory_plot, percentile_plot, sweep_plot, timeline_plot
from loadtests.report import Report, latency_rows

_FEW: Final = 10
"""Fewer times than these beyond a percentile, and its figure is shown pale."""
_ENVIRONMENT: Final = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def page(report: Report) -> str:
    """The whole HTML document."""
    result = report.result
    overall = result.overall
    return _ENVIRONMENT.get_template("page.html").render(
        report=report,
        result=result,
        few=_FEW,
        percentiles=list(PERCENTILES),
        outcomes=OUTCOMES,
        rows=latency_rows,
        phases={overall.window.name: overall} | result.phases,
        problems=[f"{count} x {problem}" for problem, count in overall.problems().items()],
        facts=_flat(report.setup.to_json()) | report.client | report.versions | overall.to_json()["by_kind"],
        percentile_plot=percentile_plot,
        timeline_plot=timeline_plot,
        sweep_plot=sweep_plot,
        memory_plot=memory_plot,
    )


def _flat(setup: Mapping[str, Any]) -> dict[str, Any]:
    mix = {
        name: ", ".join(f"{choice} x {weight:g}" for choice, weight in weights.items())
        if isinstance(weights, Mapping)
        else weights
        for name, weights in setup["mix"].items()
    }
    return {name: value for name, value in setup.items() if name != "mix"} | mix
