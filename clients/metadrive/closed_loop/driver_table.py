"""How drivers compare over the same episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from looktwice.clients.metadrive.closed_loop.drives import EXPERT, Drive
from looktwice.clients.metadrive.closed_loop.pilots import ConstantVelocity
from looktwice.model.driving.columns import Columns, aligned, cells, titles
from looktwice.model.driving.intervals import Array, ratio_difference_interval, ratio_interval

_COLUMNS: Final[Columns] = {
    "episodes": ("episodes", "{:d}"),
    "km": ("km", "{:.1f}"),
    "route_completion": ("route completion", "{:.1%}"),
    "collisions": ("collisions", "{:d}"),
    "collisions_per_km": ("collisions per km", "{:.2f}"),
    "off_road": ("off road", "{:d}"),
    "off_road_per_km": ("off road per km", "{:.2f}"),
    "jerk_ms3": ("jerk ms3", "{:.1f}"),
    "lateral_ms2": ("lateral ms2", "{:.1f}"),
    "think_rate": ("think rate", "{:.1%}"),
    "plans": ("plans", "{:d}"),
    "deadline_misses": ("deadline misses", "{:d}"),
    "plan_ms": ("plan ms", "{:.0f}"),
}
_COMPARED: Final[Columns] = {
    "completion_ratio": ("completion ratio", "{:.2f}"),
    "collisions_per_km_difference": ("collisions per km, difference", "{:+.2f}"),
    "off_road_per_km_difference": ("off road per km, difference", "{:+.2f}"),
}
_NEVER: Final = "never"


@dataclass(frozen=True)
class DriverRow:
    """A driver over all episodes.

    Attributes:
        name: who.
        episodes: how many.
        km: driven along the route, all episodes together.
        route_completion: metres driven along the route, all episodes together, as a share of what the expert
            drove in the same time; None where the expert did not drive.
        collisions, off_road: episodes in which it happened.
        collisions_per_km, off_road_per_km: by the kilometres driven; None where nobody drove any.
        intervals: 95 % intervals of ``route_completion``, ``collisions_per_km`` and ``off_road_per_km``, over
            episodes drawn with replacement.
        jerk_ms3, lateral_ms2: means over episodes of their 95th percentiles.
        think_rate: share of draws that thought; None where nobody thinks.
        plans: that were made.
        deadline_misses: plans that came behind their deadline.
        plan_ms: median over episodes of their median; None where nobody was asked.
    """

    name: str
    episodes: int
    km: float
    route_completion: float | None
    collisions: int
    collisions_per_km: float | None
    off_road: int
    off_road_per_km: float | None
    jerk_ms3: float
    lateral_ms2: float
    think_rate: float | None
    plans: int
    deadline_misses: int
    plan_ms: float | None
    intervals: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class DriverComparison:
    """A driver against another, paired over the episodes that both drove.

    Attributes:
        driver, against: their names.
        episodes: that both drove.
        completion_ratio: metres driven along the route, as a share of what the other drove; None where that
            is nothing.
        collisions_per_km_difference, off_road_per_km_difference: by how much the driver has more of them
            than the other; None where one of the two drove nothing.
        intervals: their 95 % intervals, over episodes drawn with replacement for both at once.
    """

    driver: str
    against: str
    episodes: int
    completion_ratio: float | None
    collisions_per_km_difference: float | None
    off_road_per_km_difference: float | None
    intervals: dict[str, tuple[float, float]]


def driver_rows(drives: Mapping[str, Sequence[Drive]]) -> list[DriverRow]:
    """A row for each driver, in the order given."""
    experts = {drive.seed: drive.driven_m for drive in drives.get(EXPERT, ())}
    return [_row(name, of, experts) for name, of in drives.items()]


def _row(name: str, drives: Sequence[Drive], experts_m: Mapping[int, float]) -> DriverRow:
    rates = [(drive.thought, drive.plans) for drive in drives if drive.thought is not None]
    times = [drive.milliseconds for drive in drives if drive.milliseconds is not None]
    km, collided, left = _amounts(drives)
    whole_km = np.array([experts_m.get(drive.seed, 0.0) / 1000 for drive in drives])
    ratios = {
        "route_completion": (km, whole_km),
        "collisions_per_km": (collided, km),
        "off_road_per_km": (left, km),
    }
    told = {name: float(of.sum() / by.sum()) for name, (of, by) in ratios.items() if by.any()}
    return DriverRow(
        name=name,
        episodes=len(drives),
        km=float(km.sum()),
        route_completion=told.get("route_completion"),
        collisions=int(collided.sum()),
        collisions_per_km=told.get("collisions_per_km"),
        off_road=int(left.sum()),
        off_road_per_km=told.get("off_road_per_km"),
        jerk_ms3=float(np.mean([drive.jerk_ms3 for drive in drives])),
        lateral_ms2=float(np.mean([drive.lateral_ms2 for drive in drives])),
        think_rate=_mean_of_plans(rates),
        plans=sum(drive.plans for drive in drives),
        deadline_misses=sum(drive.late for drive in drives),
        plan_ms=float(np.median(times)) if times else None,
        intervals={name: ratio_interval(*ratios[name]) for name in told},
    )


def _mean_of_plans(rates: Sequence[tuple[float, int]]) -> float | None:
    """The mean of rates, each with the plans that it is of; None where there are none."""
    plans = sum(count for _, count in rates)
    return sum(rate * count for rate, count in rates) / plans if plans else None


def _amounts(drives: Sequence[Drive]) -> tuple[Array, Array, Array]:
    """Kilometres driven, and 1 where it collided and where it left the road, each [episodes]."""
    km = np.array([drive.driven_m / 1000 for drive in drives])
    collided = np.array([drive.ended == "collision" for drive in drives], np.float64)
    left = np.array([drive.off_road for drive in drives], np.float64)
    return km, collided, left


def driver_comparisons(drives: Mapping[str, Sequence[Drive]]) -> list[DriverComparison]:
    """Every other driver against ``never`` or, where it did not drive, the first that is not a limit.

    The expert and constant velocity are the limits. A driver that shares no episode with the other is left
    out.
    """
    limits = (EXPERT, ConstantVelocity.name)
    against = _NEVER if _NEVER in drives else next((name for name in drives if name not in limits), None)
    if against is None:
        return []
    others = {drive.seed: drive for drive in drives[against]}
    comparisons = []
    for name, of in drives.items():
        shared = [drive for drive in of if drive.seed in others]
        if name != against and shared:
            comparisons.append(_comparison(name, shared, against, [others[drive.seed] for drive in shared]))
    return comparisons


def _comparison(
    driver: str, drives: Sequence[Drive], against: str, others: Sequence[Drive]
) -> DriverComparison:
    """Of drives of the same episodes, in the same order."""
    km, collided, left = _amounts(drives)
    others_km, others_collided, others_left = _amounts(others)
    values, intervals = dict[str, float](), dict[str, tuple[float, float]]()
    if others_km.any():
        values["completion_ratio"] = float(km.sum() / others_km.sum())
        intervals["completion_ratio"] = ratio_interval(km, others_km)
    if km.any() and others_km.any():
        for name, count, others_count in (
            ("collisions_per_km_difference", collided, others_collided),
            ("off_road_per_km_difference", left, others_left),
        ):
            values[name] = float(count.sum() / km.sum() - others_count.sum() / others_km.sum())
            intervals[name] = ratio_difference_interval(count, km, others_count, others_km)
    return DriverComparison(
        driver=driver,
        against=against,
        episodes=len(drives),
        completion_ratio=values.get("completion_ratio"),
        collisions_per_km_difference=values.get("collisions_per_km_difference"),
        off_road_per_km_difference=values.get("off_road_per_km_difference"),
        intervals=intervals,
    )


def drives_to_json(drives: Mapping[str, Sequence[Drive]]) -> dict[str, Any]:
    """``drivers[]`` with every episode of each, and ``comparisons[]``."""
    return {
        "drivers": [
            asdict(row) | {"drives": [asdict(drive) for drive in drives[row.name]]}
            for row in driver_rows(drives)
        ],
        "comparisons": [asdict(comparison) for comparison in driver_comparisons(drives)],
    }


def format_driver_rows(rows: Sequence[DriverRow], comparisons: Sequence[DriverComparison] = ()) -> str:
    """The rows as plain text; where there are comparisons, they follow with their 95 % intervals."""
    lines = [["", *titles(_COLUMNS)]]
    lines += [[row.name, *cells(_COLUMNS, asdict(row))] for row in rows]
    if not comparisons:
        return "\n".join(aligned(lines))
    compared = [["", "episodes", *titles(_COMPARED, _COMPARED)]]
    for each in comparisons:
        intervals = {name: each.intervals.get(name) for name in _COMPARED}
        figures = cells(_COMPARED, asdict(each), intervals, _COMPARED)
        compared.append([f"{each.driver} : {each.against}", str(each.episodes), *figures])
    return "\n".join([*aligned(lines), "", *aligned(compared)])
