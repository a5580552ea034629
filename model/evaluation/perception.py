"""How well a checkpoint's pictures are read: every fact that decides a plan, against what is true."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from itertools import islice
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.columns import Columns, aligned, cells, titles
from looktwice.model.driving.facts import (
    FACTS,
    LANES,
    ROAD_DISTANCES_M,
    ROAD_SCALE_M,
    SPEED_SCALE_MS,
    WALKERS,
    scene_facts,
)
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.reading_planner import read_pictures

_BATCH: Final = 16
_NEAR_M: Final = 60.0
_DISTANCES_M: Final = ((0.0, 20.0), (20.0, 40.0), (40.0, 60.0))

Array = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FactReadings:
    """Facts [n, len(FACTS)] of n scenes with a route.

    Attributes:
        read: from pictures; probabilities for what is or is not so.
        true: NaN where a fact does not apply.
        history, route, future: float32 [n, 16, 4], [n, 20, 2], [n, 64, 4].
        episodes: int64 [n], the seed of each scene's episode.
    """

    read: Array
    true: Array
    history: Array
    route: Array
    future: Array
    episodes: npt.NDArray[np.int64]


def read_facts(
    loaded: Loaded,
    scenes: Iterable[LabelledScene],
    on_done: Callable[[int], None] | None = None,
) -> FactReadings:
    """Look at scenes through a checkpoint; those without a route are left out.

    Args:
        loaded: with a resampler.
        scenes: labelled.
        on_done: told how many scenes are done.

    Raises:
        ValueError: the checkpoint has no resampler, or no scene has a route.
    """
    if loaded.model.resampler is None:
        raise ValueError(f"{loaded.card.name} has no resampler: its perception cannot be read")
    parts: list[FactReadings] = []
    done = 0
    for batch in _batches(labelled for labelled in scenes if labelled.scene.route is not None):
        parts.append(_reading(loaded, batch))
        done += len(batch)
        if on_done is not None:
            on_done(done)
    if not parts:
        raise ValueError("no scene has a route: facts are relative to one")
    columns = [[getattr(part, field.name) for part in parts] for field in fields(FactReadings)]
    return FactReadings(*(np.concatenate(column) for column in columns))


def _reading(loaded: Loaded, batch: list[LabelledScene]) -> FactReadings:
    return FactReadings(
        read=read_pictures(loaded, [labelled.scene for labelled in batch]).numpy(),
        true=np.stack([scene_facts(labelled) for labelled in batch]),
        history=np.stack([labelled.scene.history for labelled in batch]),
        route=np.stack([np.asarray(labelled.scene.route) for labelled in batch]),
        future=np.stack([labelled.future for labelled in batch]),
        episodes=np.array([labelled.seed for labelled in batch]),
    )


def _batches(scenes: Iterator[LabelledScene]) -> Iterator[list[LabelledScene]]:
    while batch := list(islice(scenes, _BATCH)):
        yield batch


def perception_rows(reading: FactReadings) -> list[dict[str, Any]]:
    """What a table of perception tells, a row for each fact: ``fact``, ``scenes``, and its measures.

    ``auc`` is for facts that are or are not so, ``error`` the median in the fact's unit, ``r2`` the share of
    the variance that is explained.
    """
    rows: list[dict[str, Any]] = []
    for name, lanes in (("own lane", LANES[:1]), ("lanes beside", LANES[1:])):
        leads = _stacked(reading, [f"{lane}_0" for lane in lanes])
        rows.append({"fact": f"{name}: lead present"} | _yes_or_no(*leads["present"]))
        for low, high in ((0.0, _NEAR_M), *_DISTANCES_M):
            within = f"{name}, {low:.0f} to {high:.0f} m"
            gap = np.expm1(leads["gap_log_m"][1])
            here = (gap >= low) & (gap < high)  # False where there is nobody (NaN)
            chosen = {field: (read[here], true[here]) for field, (read, true) in leads.items()}
            read_gap, true_gap = (np.expm1(side) for side in chosen["gap_log_m"])
            rows.append({"fact": f"{within}: gap, m"} | _amount(read_gap, true_gap))
            rows.append(
                {"fact": f"{within}: speed along the lane, m/s"}
                | _amount(*(SPEED_SCALE_MS * side for side in chosen["speed"]))
            )
            for field in ("standing", "braking", "fixed"):
                rows.append({"fact": f"{within}: {field}"} | _yes_or_no(*chosen[field]))
        obstacles = _stacked(reading, [f"{lane}_obstacle" for lane in lanes])
        rows.append({"fact": f"{name}: obstacle present"} | _yes_or_no(*obstacles["present"]))
    walkers = _stacked(reading, [f"walker_{rank}" for rank in range(WALKERS)])
    rows.append({"fact": "walker present"} | _yes_or_no(*walkers["present"]))
    rows.append({"fact": "walker: along, m"} | _amount(*(np.expm1(s) for s in walkers["along_log_m"])))
    for distance in (ROAD_DISTANCES_M[2], ROAD_DISTANCES_M[-1]):
        place = FACTS.index(f"road_left_{distance}m")
        sides = (ROAD_SCALE_M * side[:, place] for side in (reading.read, reading.true))
        rows.append({"fact": f"road to the left after {distance} m, m"} | _amount(*sides))
    return rows


def _stacked(reading: FactReadings, prefixes: list[str]) -> dict[str, tuple[Array, Array]]:
    """Fields of facts with any of the prefixes, (read, true), one prefix after the other."""
    told = [name.removeprefix(f"{prefixes[0]}_") for name in FACTS if name.startswith(f"{prefixes[0]}_")]
    places = {field: [FACTS.index(f"{prefix}_{field}") for prefix in prefixes] for field in told}
    return {
        field: (reading.read[:, where].T.ravel(), reading.true[:, where].T.ravel())
        for field, where in places.items()
    }


def _yes_or_no(read: Array, true: Array) -> dict[str, Any]:
    known = np.isfinite(true)
    return {"scenes": int(known.sum()), "auc": auc(read[known], true[known] > 0.5)}


def _amount(read: Array, true: Array) -> dict[str, Any]:
    known = np.isfinite(true)
    read, true = read[known], true[known]
    if not len(true):
        return {"scenes": 0, "error": None, "r2": None}
    spread = float(true.var())
    r2 = 1 - float(((read - true) ** 2).mean()) / spread if spread > 0 else None
    return {"scenes": len(true), "error": float(np.median(np.abs(read - true))), "r2": r2}


def auc(scores: npt.NDArray[np.floating], positive: npt.NDArray[np.bool_]) -> float | None:
    """The chance that a positive has a higher score than a negative; ties count half, None without both."""
    positives, negatives = int(positive.sum()), int((~positive).sum())
    if not positives or not negatives:
        return None
    _, place, counts = np.unique(scores, return_inverse=True, return_counts=True)
    middle_rank = np.cumsum(counts) - (counts - 1) / 2
    ranks = middle_rank[place]
    return float((ranks[positive].sum() - positives * (positives + 1) / 2) / (positives * negatives))


_COLUMNS: Final[Columns] = {
    "scenes": ("scenes", "{:d}"),
    "auc": ("AUC", "{:.3f}"),
    "error": ("error", "{:.2f}"),
    "r2": ("R2", "{:.2f}"),
}


def format_perception(rows: list[dict[str, Any]]) -> str:
    """The rows as plain text."""
    nothing = dict.fromkeys(_COLUMNS)
    lines = [[row["fact"], *cells(_COLUMNS, nothing | row)] for row in rows]
    return "\n".join(aligned([["", *titles(_COLUMNS)], *lines]))
