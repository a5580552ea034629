"""How drivers compare over the same episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from clients.metadrive.drive import EXPERT, Drive

_COLUMNS: Final = (
    ("episodes", "{:d}"),
    ("route_completion", "{:.1%}"),
    ("collisions", "{:d}"),
    ("off_road", "{:d}"),
    ("jerk_ms3", "{:.1f}"),
    ("lateral_ms2", "{:.1f}"),
    ("think_rate", "{:.1%}"),
    ("plans", "{:d}"),
    ("deadline_misses", "{:d}"),
    ("plan_ms", "{:.0f}"),
)


@dataclass(frozen=True)
class DriverRow:
    """A driver over all episodes.

    Attributes:
        name: who.
        episodes: how many.
        route_completion: metres driven along the route, all episodes together, as a share of what the expert
            drove in the same time; None where the expert did not drive.
        collisions, off_road: episodes in which it happened.
        jerk_ms3, lateral_ms2: means over episodes of their 95th percentiles.
        think_rate: share of draws that thought; None where nobody thinks.
        plans: that were made.
        deadline_misses: plans that came behind their deadline.
        plan_ms: median over episodes of their median; None where nobody was asked.
    """

    name: str
    episodes: int
    route_completion: float | None
    collisions: int
    off_road: int
    jerk_ms3: float
    lateral_ms2: float
    think_rate: float | None
    plans: int
    deadline_misses: int
    plan_ms: float | None


def driver_rows(drives: Mapping[str, Sequence[Drive]]) -> list[DriverRow]:
    """A row for each driver, in the order given."""
    whole_m = sum(drive.driven_m for drive in drives.get(EXPERT, ())) or None
    return [_row(name, of, whole_m) for name, of in drives.items()]


def _row(name: str, drives: Sequence[Drive], whole_m: float | None) -> DriverRow:
    rates = [drive.thought for drive in drives if drive.thought is not None]
    times = [drive.milliseconds for drive in drives if drive.milliseconds is not None]
    return DriverRow(
        name=name,
        episodes=len(drives),
        route_completion=None if whole_m is None else sum(drive.driven_m for drive in drives) / whole_m,
        collisions=sum(drive.ended == "collision" for drive in drives),
        off_road=sum(drive.off_road for drive in drives),
        jerk_ms3=float(np.mean([drive.jerk_ms3 for drive in drives])),
        lateral_ms2=float(np.mean([drive.lateral_ms2 for drive in drives])),
        think_rate=float(np.mean(rates)) if rates else None,
        plans=sum(drive.plans for drive in drives),
        deadline_misses=sum(drive.late for drive in drives),
        plan_ms=float(np.median(times)) if times else None,
    )


def to_json(drives: Mapping[str, Sequence[Drive]]) -> dict[str, Any]:
    """``drivers[]`` with every episode of each."""
    return {
        "drivers": [
            asdict(row) | {"drives": [asdict(drive) for drive in drives[row.name]]}
            for row in driver_rows(drives)
        ]
    }


def format_table(rows: Sequence[DriverRow]) -> str:
    """The rows as plain text."""
    lines = [["", *(name.replace("_", " ") for name, _ in _COLUMNS)]]
    for row in rows:
        values = asdict(row)
        cells = ["-" if values[name] is None else form.format(values[name]) for name, form in _COLUMNS]
        lines.append([row.name, *cells])
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    )
