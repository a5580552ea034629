"""The open-loop table: one row a variant, as JSON and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from model.driving.intervals import Interval
from model.engines.engine import Thinking
from model.evaluation.bootstrap import Comparison, mean_interval
from model.evaluation.open_loop import MEASURES, SceneResult


@dataclass(frozen=True)
class Row:
    """One row: a variant's means over scenes, and their 95 % intervals over episodes.

    Attributes:
        name: the variant.
        thinking: who decided at the branch; None for baselines.
        n: draws per scene.
        route: whether the route was given.
        subgroup: which scenes, None for all of them.
        scenes, episodes: how many.
        values, intervals: by measure (`MEASURES`); None where a measure has no meaning.
    """

    name: str
    thinking: Thinking | None
    n: int
    route: bool
    subgroup: str | None
    scenes: int
    episodes: int
    values: Mapping[str, float | None]
    intervals: Mapping[str, Interval | None]

    @classmethod
    def from_results(
        cls,
        name: str,
        results: Sequence[SceneResult],
        *,
        thinking: Thinking | None = None,
        n: int = 1,
        route: bool = False,
        subgroup: str | None = None,
    ) -> Row:
        """Average results over scenes; raises ValueError without any."""
        if not results:
            raise ValueError(f"row {name!r} has no scenes")
        means = {measure: mean_interval(results, measure) for measure in MEASURES}
        return cls(
            name=name,
            thinking=thinking,
            n=n,
            route=route,
            subgroup=subgroup,
            scenes=len(results),
            episodes=len({result.episode_id for result in results}),
            values={measure: mean for measure, (mean, _) in means.items()},
            intervals={measure: interval for measure, (_, interval) in means.items()},
        )

    def to_json(self) -> dict[str, Any]:
        """The row with its measures as keys of their own, intervals below ``intervals``."""
        return {
            "name": self.name,
            "thinking": self.thinking,
            "n": self.n,
            "route": self.route,
            "subgroup": self.subgroup,
            "scenes": self.scenes,
            "episodes": self.episodes,
            **self.values,
            "intervals": {
                measure: list(interval)
                for measure, interval in self.intervals.items()
                if interval is not None
            },
        }


def to_json(rows: Sequence[Row], comparisons: Sequence[Comparison] = ()) -> dict[str, Any]:
    """The whole report: ``scenes``, ``episodes``, ``rows`` and ``comparisons``."""
    return {
        "scenes": max((row.scenes for row in rows), default=0),
        "episodes": max((row.episodes for row in rows), default=0),
        "rows": [row.to_json() for row in rows],
        "comparisons": [asdict(comparison) for comparison in comparisons],
    }


_COLUMNS: Final[tuple[tuple[str, str, str], ...]] = (
    ("agreed_ade_m", "ADE m", "{:.2f}"),
    ("greedy_ade_m", "greedy", "{:.2f}"),
    ("avg_ade_m", "avgADE m", "{:.2f}"),
    ("min_ade_m", "minADE m", "{:.2f}"),
    ("path_error_m", "path m", "{:+.1f}"),
    ("min_fde_m", "minFDE m", "{:.2f}"),
    ("avg_fde_m", "avgFDE m", "{:.2f}"),
    ("corner_distance_m", "corner m", "{:.2f}"),
    ("collision_rate", "collision", "{:.1%}"),
    ("off_road_rate", "off-road", "{:.1%}"),
    ("agreement_plan_trajectory", "plan~path", "{:.3f}"),
    ("agreement_reason_change", "reason~change", "{:.0%}"),
    ("agreement_reason_view", "reason~view", "{:.0%}"),
    ("unknown_words", "non-words", "{:.2f}"),
    ("plan_iou_first", "plan IOU", "{:.3f}"),
    ("plan_iou_revised", "revised", "{:.3f}"),
    ("output_tokens", "tokens", "{:.0f}"),
    ("think_rate", "thinks", "{:.1%}"),
)


def format_table(rows: Sequence[Row], comparisons: Sequence[Comparison] = ()) -> str:
    """The table as plain text; the ADE that is driven by carries its 95 % interval, comparisons follow."""
    header = ["", "scenes", "n", *(title for _, title, _ in _COLUMNS)]
    header.insert(4, "95 %")
    lines = aligned([header, *(_cells(row) for row in rows)])
    lines += aligned([comparison_cells(comparison) for comparison in comparisons])
    return "\n".join(lines) + "\n"


def _cells(row: Row) -> list[str]:
    def shown(measure: str, pattern: str) -> str:
        value = row.values[measure]
        return "-" if value is None else pattern.format(value)

    name = row.name if row.subgroup is None else f"{row.name} [{row.subgroup}]"
    cells = [
        name,
        str(row.scenes),
        str(row.n),
        *(shown(measure, pattern) for measure, _, pattern in _COLUMNS),
    ]
    cells.insert(4, _shown_interval(row.intervals["agreed_ade_m"]))
    return cells


def comparison_cells(comparison: Comparison) -> list[str]:
    """The cells of a comparison: both means, their ratio and difference, with 95 % intervals."""
    ratio = "" if comparison.ratio is None else f"ratio {comparison.ratio:.3f}"
    return [
        comparison.name,
        comparison.measure,
        f"{comparison.value:.3f} : {comparison.against:.3f}",
        ratio,
        _shown_interval(comparison.ratio_interval),
        f"difference {comparison.difference:+.3f}",
        _shown_interval(comparison.difference_interval),
    ]


def _shown_interval(interval: Interval | None) -> str:
    return "" if interval is None else f"{interval[0]:.2f}..{interval[1]:.2f}"


def aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """Columns padded to their widest cell: the first one to the left, numbers to the right."""
    if not lines:
        return []
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return [
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
