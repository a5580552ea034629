"""Pictures of a ladder: thinking over difficulty, over temperature, and what thinking costs and brings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from looktwice.model.evaluation.ladder import Difficulty
from looktwice.model.evaluation.table import VariantRow

_THINK: Final = "#c9772b"
_ERROR: Final = "#2b6cb0"
_PALE: Final = "#9db8d4"
_APART: Final = 0.03
"""Of a picture's width: numbers less apart are left out."""


def difficulty_plot(groups: Sequence[Difficulty], picture: Path) -> None:
    """CF-VLA's figure 1, top: think rate and error from easy to hard scenes; a PNG."""
    figure, axes = _axes("scenes from easy to hard, by minADE without thinking")
    places = range(1, len(groups) + 1)
    axes.bar(places, [group.think_rate for group in groups], color=_THINK, alpha=0.75, label="think rate")
    axes.set_ylabel("think rate", color=_THINK)
    axes.set_ylim(0, 1)
    axes.set_xticks(list(places))
    errors = axes.twinx()
    errors.plot(places, [group.never_m for group in groups], color=_PALE, marker="o", label="never thinks")
    errors.plot(places, [group.adaptive_m for group in groups], color=_ERROR, marker="o", label="adaptive")
    errors.set_ylabel("minADE, m", color=_ERROR)
    errors.set_ylim(bottom=0)
    errors.legend(loc="upper left", frameon=False)
    figure.savefig(picture, format="png")


def temperature_plot(points: Sequence[tuple[float, VariantRow]], picture: Path) -> None:
    """CF-VLA's figure 8: think rate and minADE over the sampling temperature; a PNG."""
    figure, axes = _axes("temperature")
    temperatures = [value for value, _ in points]
    axes.plot(temperatures, [_of(row, "think_rate") for _, row in points], color=_THINK, marker="s")
    axes.set_ylabel("think rate", color=_THINK)
    axes.set_ylim(bottom=0)
    errors = axes.twinx()
    errors.plot(temperatures, [_of(row, "min_ade_m") for _, row in points], color=_ERROR, marker="o")
    errors.set_ylabel("minADE, m", color=_ERROR)
    figure.savefig(picture, format="png")


def threshold_plot(points: Sequence[tuple[float, VariantRow]], picture: Path) -> None:
    """Risk over compute: errors and collisions over the tokens that each think threshold costs; a PNG."""
    figure, axes = _axes("tokens a draw")
    tokens = [_of(row, "output_tokens") for _, row in points]
    axes.plot(tokens, [_of(row, "min_ade_m") for _, row in points], color=_ERROR, marker="o", label="minADE")
    apart, last = _APART * (max(tokens) - min(tokens)), -1.0
    for (value, row), x in zip(points, tokens, strict=True):
        # Where thresholds cost the same their numbers would lie one on the other.
        if last < 0 or abs(x - last) >= apart:
            axes.annotate(
                f"{value:g}",
                (x, _of(row, "min_ade_m")),
                xytext=(0, 6),
                textcoords="offset points",
                fontsize=7,
            )
            last = x
    axes.margins(y=0.1)
    axes.set_ylabel("minADE, m (numbers: think threshold)", color=_ERROR)
    risk = axes.twinx()
    risk.plot(tokens, [_of(row, "collision_rate") for _, row in points], color=_THINK, marker="s")
    risk.set_ylabel("collision rate", color=_THINK)
    risk.margins(y=0.1)
    figure.savefig(picture, format="png")


def _axes(x_label: str) -> tuple[Figure, Axes]:
    figure = Figure((6.4, 3.8), dpi=130, layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel(x_label)
    return figure, axes


def _of(row: VariantRow, measure: str) -> float:
    value = row.values[measure]
    if value is None:
        raise ValueError(f"row {row.name!r} has no {measure}")
    return value
