"""Training curves from a trainer's JSON lines."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure


def training_curves(log: Path, picture: Path) -> None:
    """Plot the last stage of a log of JSON rows ``{"stage": …, "step": …, "loss": …}`` as a PNG.

    Numbers whose name contains ``loss`` share the upper axes, those with ``ade`` the lower ones; everything
    else is left out.

    Raises:
        ValueError: a line that is no JSON object, or a log without any such number.
    """
    rows = [_row(line, number) for number, line in enumerate(log.read_text().splitlines(), 1) if line.strip()]
    rows = [row for row in rows if row.get("stage") == rows[-1].get("stage")]
    names = sorted({name for row in rows for name, value in row.items() if isinstance(value, (int, float))})
    panels = [
        (title, [name for name in names if part in name.lower()])
        for title, part in (("loss", "loss"), ("displacement error, m", "ade"))
    ]
    panels = [(title, shown) for title, shown in panels if shown]
    if not panels:
        raise ValueError(f"{log} holds neither a loss nor a displacement error")
    figure = Figure((9, 3.2 * len(panels)), dpi=110, layout="constrained")
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)
    for axes, (title, shown) in zip(grid[:, 0], panels, strict=True):
        _draw_panel(axes, title, shown, rows)
    grid[-1, 0].set_xlabel("step")
    figure.savefig(picture, format="png")


def _row(line: str, number: int) -> Mapping[str, Any]:
    row = json.loads(line)
    if not isinstance(row, dict) or "step" not in row:
        raise ValueError(f"line {number} of the training log is no row with a step")
    return row


def _draw_panel(axes: Axes, title: str, names: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    for name in names:
        points = [(row["step"], row[name]) for row in rows if isinstance(row.get(name), (int, float))]
        axes.plot(
            *zip(*points, strict=True), label=name, linewidth=1.4, marker="." if len(points) < 60 else ""
        )
    axes.set_ylabel(title)
    axes.grid(color="#e6eaee")
    axes.set_axisbelow(True)
    axes.spines[["right", "top"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9)
