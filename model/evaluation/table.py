"""The open-loop table: one row a variant, as JSON and as text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from looktwice.model.driving.columns import Columns, aligned, cells, interval_cell, titles
from looktwice.model.engines.engine import Thinking
from looktwice.model.evaluation.bootstrap import Comparison
from looktwice.model.evaluation.figures import FigureRow


@dataclass(frozen=True)
class VariantRow(FigureRow):
    """A variant's row, with all `MEASURES`.

    Attributes:
        thinking: who decided at the branch; None for baselines.
        n: draws per scene.
        route: whether the route was given.
        subgroup: which scenes, None for all of them.
    """

    thinking: Thinking | None = None
    n: int = 1
    route: bool = False
    subgroup: str | None = None


def to_json(rows: Sequence[VariantRow], comparisons: Sequence[Comparison] = ()) -> dict[str, Any]:
    """The whole report: ``scenes``, ``episodes``, ``rows`` and ``comparisons``."""
    return {
        "scenes": max((row.scenes for row in rows), default=0),
        "episodes": max((row.episodes for row in rows), default=0),
        "rows": [row.to_json() for row in rows],
        "comparisons": [asdict(comparison) for comparison in comparisons],
    }


_COLUMNS: Final[Columns] = {
    "agreed_ade_m": ("ADE m", "{:.2f}"),
    "greedy_ade_m": ("greedy", "{:.2f}"),
    "avg_ade_m": ("avgADE m", "{:.2f}"),
    "min_ade_m": ("minADE m", "{:.2f}"),
    "path_error_m": ("path m", "{:+.1f}"),
    "min_fde_m": ("minFDE m", "{:.2f}"),
    "avg_fde_m": ("avgFDE m", "{:.2f}"),
    "corner_distance_m": ("corner m", "{:.2f}"),
    "collision_rate": ("collision", "{:.1%}"),
    "off_road_rate": ("off-road", "{:.1%}"),
    "agreement_plan_trajectory": ("plan~path", "{:.3f}"),
    "agreement_reason_change": ("reason~change", "{:.0%}"),
    "agreement_reason_view": ("reason~view", "{:.0%}"),
    "unknown_words": ("non-words", "{:.2f}"),
    "plan_iou_first": ("plan IOU", "{:.3f}"),
    "plan_iou_revised": ("revised", "{:.3f}"),
    "output_tokens": ("tokens", "{:.0f}"),
    "think_rate": ("thinks", "{:.1%}"),
}
_WITH_INTERVAL: Final = ("agreed_ade_m",)
"""The ADE that is driven by; JSON has all intervals."""


def format_table(rows: Sequence[VariantRow], comparisons: Sequence[Comparison] = ()) -> str:
    """The table as plain text; the ADE that is driven by carries its 95 % interval, comparisons follow."""
    lines = [["", "scenes", "n", *titles(_COLUMNS, _WITH_INTERVAL)]]
    for row in rows:
        name = row.name if row.subgroup is None else f"{row.name} [{row.subgroup}]"
        figures = cells(_COLUMNS, row.values, row.intervals, _WITH_INTERVAL)
        lines.append([name, str(row.scenes), str(row.n), *figures])
    shown = [*aligned(lines), *aligned([comparison_cells(comparison) for comparison in comparisons])]
    return "\n".join(shown) + "\n"


def comparison_cells(comparison: Comparison) -> list[str]:
    """The cells of a comparison: both means, their ratio and difference, with 95 % intervals."""
    ratio = "" if comparison.ratio is None else f"ratio {comparison.ratio:.3f}"
    return [
        comparison.name,
        comparison.measure,
        f"{comparison.value:.3f} : {comparison.against:.3f}",
        ratio,
        interval_cell(comparison.ratio_interval, "{:.2f}"),
        f"difference {comparison.difference:+.3f}",
        interval_cell(comparison.difference_interval, "{:.3f}"),
    ]
