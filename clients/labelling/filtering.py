"""Filter: the scenes in which the model's own plan is what goes wrong (CF-VLA section 3.3)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from clients.labelling.ledger import Entry
from clients.labelling.rollout import min_ade_m

QUIET = "quiet"
"""The tag of scenes that have none."""


@dataclass(frozen=True)
class Thresholds:
    """Which scenes are kept.

    Attributes:
        epsilon_m: the free draws' minADE must be above it: what is mastered needs no label.
        gain_m: by which the expert's plan must make minADE smaller.
        everything: keep all, as the paper's comparison "whole dataset" does.
    """

    epsilon_m: float = 0.5
    gain_m: float = 0.0
    everything: bool = False

    def keep(self, free_m: float, prefilled_m: float) -> bool:
        """Whether a scene with these minADE is kept."""
        return self.everything or (free_m > self.epsilon_m and free_m - prefilled_m > self.gain_m)


@dataclass(frozen=True)
class Filtered:
    """A rolled-out scene with what the filter looks at; ``plan_iou`` is the mean of the free draws."""

    entry: Entry
    free_m: float
    prefilled_m: float
    plan_iou: float
    kept: bool


def filtered(entries: Iterable[Entry], thresholds: Thresholds) -> list[Filtered]:
    """Every rolled-out scene, kept or not."""
    found = []
    for entry in entries:
        free, prefilled = entry.record["free"], entry.record["prefilled"]
        free_m, prefilled_m = min_ade_m(free), min_ade_m(prefilled)
        overlap = sum(draw["plan_iou"] for draw in free) / len(free)
        found.append(Filtered(entry, free_m, prefilled_m, overlap, thresholds.keep(free_m, prefilled_m)))
    return found


def summary(scenes: Iterable[Filtered]) -> dict[str, Any]:
    """How many are kept, in all and per difficulty tag."""
    total, kept = Counter[str](), Counter[str]()
    count = 0
    for scene in scenes:
        count += 1
        for tag in scene.entry.record["tags"] or [QUIET]:
            total[tag] += 1
            kept[tag] += scene.kept
        kept[""] += scene.kept
    return {
        "scenes": count,
        "kept": kept[""],
        "tags": {tag: {"scenes": total[tag], "kept": kept[tag]} for tag in sorted(total)},
    }
