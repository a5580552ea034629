"""Means of measures over scenes with intervals over episodes, as rows of tables and as JSON."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

from looktwice.model.driving.columns import Columns, cells, titles
from looktwice.model.driving.intervals import Interval
from looktwice.model.evaluation.bootstrap import Measured, mean_interval


@dataclass(frozen=True)
class FigureRow:
    """Means of some results over scenes, with 95 % intervals over episodes.

    Attributes:
        name: of the row.
        scenes, episodes: how many.
        values, intervals: by measure; None where no scene has it.
    """

    name: str
    scenes: int
    episodes: int
    values: Mapping[str, float | None]
    intervals: Mapping[str, Interval | None]

    @classmethod
    def of(cls, name: str, results: Sequence[Measured], measures: Sequence[str], **about: Any) -> Self:
        """The row of some results, ``about`` its further attributes; raises ValueError without any."""
        if not results:
            raise ValueError(f"row {name!r} has no scenes")
        means = {measure: mean_interval(results, measure) for measure in measures}
        return cls(
            name,
            len(results),
            len({result.episode_id for result in results}),
            {measure: mean for measure, (mean, _) in means.items()},
            {measure: interval for measure, (_, interval) in means.items()},
            **about,
        )

    def to_json(self) -> dict[str, Any]:
        """The row with its measures as keys of their own, intervals below ``intervals``."""
        intervals = {name: list(each) for name, each in self.intervals.items() if each is not None}
        about = {each.name: getattr(self, each.name) for each in fields(self)}
        del about["values"], about["intervals"]
        return about | dict(self.values) | {"intervals": intervals}


def figure_table(
    title: str, rows: Sequence[FigureRow], columns: Columns, with_intervals: Container[str]
) -> list[list[str]]:
    """Rows as cells, a header first; for `aligned`.

    Args:
        title: above the rows' names.
        rows: which have all measures of ``columns``.
        columns: to be shown.
        with_intervals: measures whose intervals are shown; JSON has all.
    """
    figures = (cells(columns, row.values, row.intervals, with_intervals) for row in rows)
    lines = [[row.name, str(row.scenes), *of] for row, of in zip(rows, figures, strict=True)]
    return [[title, "scenes", *titles(columns, with_intervals)], *lines]
