"""Filter: the scenes in which the model's own plan is what goes wrong (CF-VLA section 3.3)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from looktwice.clients.labelling.build_outcomes import Followed, plans_that_fail
from looktwice.clients.labelling.ledger import Entry
from looktwice.clients.labelling.rollout import min_ade_m

QUIET = "quiet"
"""The tag of scenes that have none."""


@dataclass(frozen=True)
class Thresholds:
    """Which scenes are kept, and which of the model's plans in them.

    Attributes:
        epsilon_m: the error without the expert's plan must be above it: what is mastered needs no label.
        gain_m: by which the expert's plan must make it smaller.
        plan_iou: None asks so of a scene's best draw, as the paper does, and keeps all plans of such a scene.
            Otherwise it is asked of every draw by itself, and a plan is kept whose IOU with the expert's is
            below this: a plan that is wrong even where others of the same model are right.
        everything: keep all, as the paper's comparison "whole dataset" does.
    """

    epsilon_m: float = 0.5
    gain_m: float = 0.0
    plan_iou: float | None = None
    everything: bool = False

    def keep(self, free: Sequence[Mapping[str, Any]], prefilled_m: float) -> tuple[int, ...]:
        """Which of the free draws of a scene are kept; of those with the same plan the first.

        Nothing is to be corrected in the expert's own plan, so that is never kept.
        """
        first: dict[str, int] = {}
        for place, draw in enumerate(free):
            if draw["plan_iou"] < 1 and self._keeps(draw, free, prefilled_m):
                first.setdefault(draw["plan"], place)
        return tuple(first.values())

    def _keeps(self, draw: Mapping[str, Any], free: Sequence[Mapping[str, Any]], prefilled_m: float) -> bool:
        if self.everything:
            return True
        if self.plan_iou is None:
            return self._is_mended(min_ade_m(free), prefilled_m)
        return draw["plan_iou"] < self.plan_iou and self._is_mended(draw["ade_m"], prefilled_m)

    def _is_mended(self, error_m: float, prefilled_m: float) -> bool:
        return error_m > self.epsilon_m and error_m - prefilled_m > self.gain_m


@dataclass(frozen=True)
class Filtered:
    """A rolled-out scene with what the filter looks at.

    Attributes:
        entry: of the ledger.
        free_m, prefilled_m: minADE without and with the expert's plan.
        plan_iou: mean of the free draws.
        draws: those that are kept, each with a plan of its own.
    """

    entry: Entry
    free_m: float
    prefilled_m: float
    plan_iou: float
    draws: tuple[int, ...]

    @property
    def selected(self) -> bool:
        """Whether anything of the scene is."""
        return bool(self.draws)


def filtered(entries: Iterable[Entry], thresholds: Thresholds) -> list[Filtered]:
    """Every rolled-out scene, kept or not."""
    return [
        _filtered(entry, thresholds.keep(entry.record["free"], min_ade_m(entry.record["prefilled"])))
        for entry in entries
    ]


def _filtered(entry: Entry, draws: tuple[int, ...]) -> Filtered:
    free, prefilled = entry.record["free"], entry.record["prefilled"]
    overlap = sum(draw["plan_iou"] for draw in free) / len(free)
    return Filtered(entry, min_ade_m(free), min_ade_m(prefilled), overlap, draws)


def filtered_by_outcome(entries: Iterable[Entry], followed: Mapping[str, Followed]) -> list[Filtered]:
    """Every rolled-out scene whose plans were followed; kept are the plans that fail (`plans_that_fail`).

    Args:
        entries: rollouts.
        followed: what came of their plans, by their keys.
    """
    return [
        _filtered(entry, plans_that_fail(entry, followed[entry.key]))
        for entry in entries
        if entry.key in followed
    ]


def summary(scenes: Iterable[Filtered]) -> dict[str, Any]:
    """How many are kept, in all and per difficulty tag; and how many plans."""
    total, kept = Counter[str](), Counter[str]()
    count = plans = 0
    for scene in scenes:
        count += 1
        plans += len(scene.draws)
        for tag in scene.entry.record["tags"] or [QUIET]:
            total[tag] += 1
            kept[tag] += scene.selected
        kept[""] += scene.selected
    return {
        "scenes": count,
        "kept": kept[""],
        "plans": plans,
        "tags": {tag: {"scenes": total[tag], "kept": kept[tag]} for tag in sorted(total)},
    }
