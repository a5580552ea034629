"""A picture of what a filter keeps: the paper's figure 3(C)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from looktwice.clients.labelling.filtering import Filtered, Thresholds

_RANGE_M: Final = (0.05, 30.0)


def scatter(scenes: Sequence[Filtered], thresholds: Thresholds | None, picture: Path) -> None:
    """minADE with the expert's plan given over minADE of free draws, coloured by plan IOU; a PNG.

    ``thresholds`` is None where scenes were not kept by these errors.
    """
    figure = Figure((6.6, 5.4), dpi=130, layout="constrained")
    axes = figure.add_subplot()
    low, high = _RANGE_M
    free, prefilled = ([min(max(value, low), high) for value in column] for column in _columns(scenes))
    overlaps = [scene.plan_iou for scene in scenes]
    points = axes.scatter(free, prefilled, c=overlaps, s=6, cmap="viridis", vmin=0, vmax=1, linewidths=0)
    axes.set(xscale="log", yscale="log", xlim=_RANGE_M, ylim=_RANGE_M, aspect="equal")
    axes.plot(_RANGE_M, _RANGE_M, color="0.3", linewidth=0.8)
    kept, where = f"{sum(scene.selected for scene in scenes)} of {len(scenes)}", ""
    if thresholds is None:
        where = ": their plans fail when followed"
    elif thresholds.everything:
        kept = "all"
    else:
        axes.axvline(thresholds.epsilon_m, color="0.3", linewidth=0.8, linestyle="--")
        where = "" if thresholds.plan_iou is not None else ": below the diagonal, right of the line"
    axes.set_title(f"{kept} scenes kept{where}")
    axes.set_xlabel("minADE of free draws, m")
    axes.set_ylabel("minADE with the expert's plan given, m")
    figure.colorbar(points, ax=axes, label="plan IOU of the free draws")
    figure.savefig(picture, format="png")


def _columns(scenes: Sequence[Filtered]) -> tuple[list[float], list[float]]:
    return [scene.free_m for scene in scenes], [scene.prefilled_m for scene in scenes]
