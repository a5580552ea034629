"""A report as one page that needs nothing from anywhere: tables and plots, no scripts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, Final

from loadtests.accounting import Summary
from loadtests.exchange import BRANCHES
from loadtests.latencies import PERCENTILES, Latencies
from loadtests.plots import memory_plot, percentile_plot, sweep_plot, timeline_plot
from loadtests.report import Report

_FEW: Final = 10
"""Fewer times than these beyond a percentile, and its figure is shown pale."""

_STYLE: Final = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1a202c; }
body { max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: 0; } h2 { font-size: 1.1rem; margin: 2rem 0 .5rem; }
p.about, .note { color: #4a5568; } .note { font-size: .85rem; }
.verdict { border-left: 4px solid #2f855a; background: #f0fff4; padding: .6rem 1rem; margin: 1rem 0; }
.verdict.bad { border-color: #c53030; background: #fff5f5; }
.verdict ul { margin: .3rem 0 0; padding-left: 1.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .5rem 0; }
th, td { padding: .2rem .8rem .2rem 0; text-align: right; border-bottom: 1px solid #e2e8f0; }
th:first-child, td:first-child { text-align: left; } th { color: #4a5568; font-weight: 500; }
td.few { color: #a0aec0; } svg { width: 100%; height: auto; }
table.facts td { text-align: left; overflow-wrap: anywhere; }
"""


def page(report: Report) -> str:
    """The whole HTML document."""
    result, setup = report.result, report.setup
    title = f"Load test: {result.scenario}"
    parts = [
        f"<h1>{escape(title)}</h1><p class='about'>{escape(report.began)} · {escape(setup.target.url)} · "
        f"{escape(_models(report.service))}</p>",
        _verdict(report),
        _list(result.findings),
        "<h2>Latency, from when a request was due</h2>",
        _latency_table(result.overall),
        f"<p class='note'>Milliseconds. Pale figures rest on fewer than {_FEW} requests beyond them.</p>",
        percentile_plot(result.overall),
        "<h2>Rates and outcomes</h2>",
        _rates({result.overall.window.name: result.overall} | result.phases),
        _problems(result.overall),
    ]
    if "points" in result.extra:
        parts += ["<h2>Sweep</h2>", sweep_plot(result.extra["points"], result.extra["knee_rps"])]
    else:
        parts += ["<h2>Request by request</h2>", timeline_plot(result)]
    if readings := result.extra.get("memory", {}).get("readings"):
        parts += ["<h2>Memory of the server</h2>", memory_plot(readings)]
    for name, part in result.phases.items():
        parts += [f"<h2>Latency: {escape(name)}</h2>", _latency_table(part)]
    parts += [
        "<h2>What it depends on</h2>",
        _facts(
            _flat(setup.to_json()) | report.client | report.versions | result.overall.to_json()["by_kind"]
        ),
    ]
    body = "\n".join(parts)
    return (
        f"<!doctype html>\n<html lang='en'><head><meta charset='utf-8'><title>{escape(title)}</title>"
        f"<meta name='viewport' content='width=device-width'><style>{_STYLE}</style></head>"
        f"<body>\n{body}\n</body></html>\n"
    )


def _verdict(report: Report) -> str:
    faults = report.result.faults
    if not faults:
        return "<div class='verdict'>Valid: this was the load that was asked for.</div>"
    return f"<div class='verdict bad'>Not valid{_list(faults)}</div>"


def _models(service: Mapping[str, Any]) -> str:
    return ", ".join(f"{card['name']} {card['revision']} on {card['engine']}" for card in service["models"])


def _latency_table(summary: Summary) -> str:
    rows = {"all": summary.latencies()} | {branch: summary.latencies(branch) for branch in BRANCHES}
    rows["sent late by"] = summary.lags()
    return _table(
        ["", *PERCENTILES, "requests"],
        [
            [f"<td>{name}</td>", *_times(latencies), f"<td>{len(latencies)}</td>"]
            for name, latencies in rows.items()
            if len(latencies)
        ],
    )


def _times(latencies: Latencies) -> list[str]:
    return [
        f"<td{' class=few' if latencies.beyond(name) < _FEW else ''}>"
        f"{(latencies.percentile_s(name) or 0) * 1e3:.1f}</td>"
        for name in PERCENTILES
    ]


def _rates(parts: Mapping[str, Summary]) -> str:
    head = [
        "",
        "s",
        "offered/s",
        "achieved/s",
        "achieved",
        "goodput",
        "answered",
        "rejected",
        "failed",
        "missed",
    ]
    return _table(
        head,
        [
            [
                f"<td>{escape(name)}</td>",
                *(
                    f"<td>{text}</td>"
                    for text in (
                        f"{part.window.seconds:.0f}",
                        f"{part.offered_rps:.2f}",
                        f"{part.achieved_rps:.2f}",
                        f"{part.achieved_share:.1%}",
                        f"{part.goodput:.1%}",
                        *(part.count(name) for name in ("answered", "rejected", "failed", "missed")),
                    )
                ),
            ]
            for name, part in parts.items()
        ],
    )


def _problems(summary: Summary) -> str:
    return _list([f"{count} x {problem}" for problem, count in summary.problems().items()])


def _facts(facts: Mapping[str, Any]) -> str:
    rows = [f"<tr><td>{escape(name)}</td><td>{escape(str(value))}</td></tr>" for name, value in facts.items()]
    return f"<table class='facts'>{''.join(rows)}</table>"


def _flat(setup: Mapping[str, Any]) -> dict[str, Any]:
    mix = {
        name: ", ".join(f"{choice} x {weight:g}" for choice, weight in weights.items())
        if isinstance(weights, Mapping)
        else weights
        for name, weights in setup["mix"].items()
    }
    return {name: value for name, value in setup.items() if name != "mix"} | mix


def _list(lines: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else ""


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    titles = "".join(f"<th>{title}</th>" for title in head)
    lines = "".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    return f"<table><tr>{titles}</tr>{lines}</table>"
