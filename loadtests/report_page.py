"""A report as one page that needs nothing from anywhere: tables, and plots as SVG; no scripts."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from looktwice.loadtests.accounting import PERCENTILES, Latencies, Summary
from looktwice.loadtests.exchange import BRANCHES, OUTCOMES, Exchange
from looktwice.loadtests.load_report import LoadReport, latency_rows
from looktwice.loadtests.load_run import Result

_COLOURS: Final = {
    "direct": "#2b6cb0",
    "think": "#c9772b",
    "reflect": "#2f855a",
    "label": "#805ad5",
    "batch": "#718096",
    "imagine": "#0987a0",
}
_ALL: Final = "#1a202c"
_PALE: Final = "#a0aec0"
_BAD: Final = "#c53030"
_NINES: Final = (0.0, 50.0, 90.0, 99.0, 99.9, 99.99)
_RASTER_FROM: Final = 1500
"""Points, from which on they are one picture within the plot: as many marks would make it slow."""


def percentile_plot(summary: Summary) -> str:
    """Latency over percentile, all answers and branch by branch, with how late requests were sent."""
    figure, axes = _figure(3.4)
    _curve(axes, summary.latencies(), "all", _ALL, "-")
    found = {branch: summary.latencies(branch) for branch in BRANCHES}
    if sum(len(each) > 0 for each in found.values()) > 1:
        for branch, latencies in found.items():
            _curve(axes, latencies, branch, _COLOURS[branch], "-")
    _curve(axes, summary.lags(), "sent late by", _PALE, ":")
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator([_nines(percent) for percent in _NINES]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda at, _: f"{100 * (1 - 1 / at):g} %"))
    axes.set_xlim(1, 10_000)
    # From a lag of microseconds to a latency of seconds.
    _seconds(axes, between=(1,))
    axes.set_ylabel("s")
    axes.set_xlabel("percentile")
    axes.axhline(summary.goal_s, color=_BAD, linewidth=0.8, linestyle="--", label="goal")
    axes.legend(frameon=False, fontsize=8)
    return _svg(figure)


def timeline_plot(result: Result) -> str:
    """Every request over when it was due; what was not answered lies on the edge above."""
    figure, axes = _figure(3.4)
    whole = result.overall.window
    shown = [each for each in result.exchanges if whole.start_s <= each.due_s < whole.end_s]
    for branch in BRANCHES:
        of = [each for each in shown if each.verdict.branch == branch]
        _scatter(axes, of, [each.latency_s for each in of], branch, _COLOURS[branch], ".")
    _seconds(axes)
    top = max((each.latency_s for each in shown if each.verdict.branch), default=1.0) * 1.5
    for outcome, colour, marker in (("rejected", _PALE, "x"), ("failed", _BAD, "x"), ("missed", _PALE, "|")):
        of = [each for each in shown if each.verdict.outcome == outcome]
        _scatter(axes, of, [top] * len(of), outcome, colour, marker)
    for place, part in enumerate(result.phases.values()):
        if place % 2:
            axes.axvspan(part.window.start_s, part.window.end_s, color=_PALE, alpha=0.2, linewidth=0)
        middle = (part.window.start_s + part.window.end_s) / 2
        axes.text(
            middle, 1.01, part.window.name, ha="center", transform=axes.get_xaxis_transform(), fontsize=8
        )
    axes.set_xlim(whole.start_s, whole.end_s)
    axes.set_xlabel("due, s from the run's start")
    axes.set_ylabel("latency, s")
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    return _svg(figure)


def sweep_plot(points: Sequence[Mapping[str, Any]], knee_rps: float | None) -> str:
    """Latency percentiles, and achieved over offered, at every rate that was tried."""
    figure, axes = _figure(3.4)
    rates = [point["offered_rps"] for point in points]
    for name, style in (("p50", "-"), ("p95", "--"), ("p99", ":")):
        axes.plot(
            rates,
            [_number(point["latency_s"][name]) for point in points],
            style,
            color=_ALL,
            marker=".",
            label=name,
        )
    _seconds(axes)
    axes.set_ylabel("latency, s")
    axes.set_xlabel("offered, requests a second")
    achieved = axes.twinx()
    achieved.plot(
        rates,
        [point["achieved_rps"] for point in points],
        color=_COLOURS["think"],
        marker="s",
        label="achieved",
    )
    achieved.plot(rates, rates, color=_PALE, linewidth=0.8)
    achieved.set_ylabel("achieved, requests a second", color=_COLOURS["think"])
    achieved.set_ylim(bottom=0)
    if knee_rps is not None:
        axes.axvline(knee_rps, color=_BAD, linewidth=0.8, linestyle="--", label="knee")
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    return _svg(figure)


def memory_plot(readings: Sequence[tuple[float, int]]) -> str:
    """The server's memory over the run."""
    figure, axes = _figure(2.6)
    axes.plot([at for at, _ in readings], [rss / 2**20 for _, rss in readings], color=_COLOURS["direct"])
    axes.set_xlabel("s from the run's start")
    axes.set_ylabel("resident, MiB")
    return _svg(figure)


def _curve(axes: Axes, latencies: Latencies, label: str, colour: str, style: str) -> None:
    if not len(latencies):
        return
    edges, counts = zip(*latencies.buckets(), strict=True)
    below = np.concatenate([[0], np.cumsum(counts)[:-1]]) / len(latencies)
    axes.step(1 / (1 - below), edges, where="post", color=colour, linestyle=style, label=label)


def _scatter(
    axes: Axes, of: Sequence[Exchange], heights: Sequence[float], label: str, colour: str, marker: str
) -> None:
    if of:
        axes.scatter(
            [each.due_s for each in of],
            heights,
            s=14,
            color=colour,
            marker=marker,
            label=label,
            linewidths=0.8,
            rasterized=len(of) > _RASTER_FROM,
        )


def _nines(percent: float) -> float:
    return 1 / (1 - percent / 100)


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _figure(height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(8.5, height), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e2e8f0", linewidth=0.6)
    axes.set_axisbelow(True)
    return figure, axes


def _seconds(axes: Axes, between: tuple[float, ...] = (1, 2, 5)) -> None:
    """Times in plain numbers, with these marks in every decade."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=between))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda at, _: f"{at:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _svg(figure: Figure) -> str:
    written = io.StringIO()
    figure.savefig(written, format="svg", dpi=150, metadata={"Date": None})
    text = written.getvalue()
    # Behind the XML declaration and the document type, which have no place within a page.
    return text[text.index("<svg") :]


_FEW: Final = 10
"""Fewer times than these beyond a percentile, and its figure is shown pale."""
_ENVIRONMENT: Final = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def page(report: LoadReport) -> str:
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
