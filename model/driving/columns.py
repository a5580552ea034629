"""Tables of figures as plain text: a line a row, "-" where a figure is missing."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence

from looktwice.model.driving.intervals import Interval

Columns = Mapping[str, tuple[str, str]]
"""Title and pattern of `str.format`, by the figure's key."""


def cell(value: float | None, pattern: str) -> str:
    """A figure as text."""
    return "-" if value is None else pattern.format(value)


def interval_cell(interval: Interval | None, pattern: str) -> str:
    """Both ends of an interval as text; empty where there is none."""
    return "" if interval is None else "..".join(map(pattern.format, interval))


def titles(columns: Columns, with_intervals: Container[str] = ()) -> list[str]:
    """Titles of all columns; some are followed by that of their intervals."""
    shown = ([title, "95 %"] if key in with_intervals else [title] for key, (title, _) in columns.items())
    return [title for each in shown for title in each]


def cells(
    columns: Columns,
    values: Mapping[str, float | None],
    intervals: Mapping[str, Interval | None] | None = None,
    with_intervals: Container[str] = (),
) -> list[str]:
    """A row's figures, those ``with_intervals`` followed by their ``intervals``."""
    row = []
    for key, (_, pattern) in columns.items():
        row.append(cell(values[key], pattern))
        if intervals is not None and key in with_intervals:
            row.append(interval_cell(intervals[key], pattern))
    return row


def aligned(lines: Sequence[Sequence[str]], left: int = 1) -> list[str]:
    """Columns padded to their widest cell: the first ``left`` to the left, figures to the right."""
    if not lines:
        return []
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return [
        "  ".join(
            text.ljust(width) if column < left else text.rjust(width)
            for column, (text, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
