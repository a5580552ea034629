"""Means of measures over scenes with intervals over episodes, as rows of tables and as JSON."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from model.driving.intervals import Interval
from model.evaluation.bootstrap import Measured, mean_interval

Columns = Mapping[str, tuple[str, str]]
"""Title and pattern, by measure."""


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
    def of(cls, name: str, results: Sequence[Measured], measures: Sequence[str]) -> Self:
        """The row of some results."""
        means = {measure: mean_interval(results, measure) for measure in measures}
        return cls(
            name,
            len(results),
            len({result.episode_id for result in results}),
            {measure: mean for measure, (mean, _) in means.items()},
            {measure: interval for measure, (_, interval) in means.items()},
        )

    def to_json(self) -> dict[str, Any]:
        """The row with its measures as keys of their own, intervals below ``intervals``."""
        intervals = {name: list(each) for name, each in self.intervals.items() if each is not None}
        about = {"name": self.name, "scenes": self.scenes, "episodes": self.episodes}
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
    header = [title, "scenes"]
    lines = [header]
    for measure, (name, _) in columns.items():
        header += [name, "95 %"] if measure in with_intervals else [name]
    for row in rows:
        cells = [row.name, str(row.scenes)]
        for measure, (_, pattern) in columns.items():
            value, interval = row.values[measure], row.intervals[measure]
            cells.append("-" if value is None else pattern.format(value))
            if measure in with_intervals:
                cells.append("" if interval is None else "..".join(map(pattern.format, interval)))
        lines.append(cells)
    return lines
