"""The ladder of CF-VLA's tables 1, 2 and 4: what each step of learning, and a second look, brings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from looktwice.model.driving.scene import LabelledScene
from looktwice.model.engines.engine import Controls, Draw, Thinking
from looktwice.model.evaluation.bootstrap import Comparison, compare
from looktwice.model.evaluation.open_loop import SceneResult, evaluate_draws
from looktwice.model.evaluation.report import EvaluationReport, variant_rows
from looktwice.model.evaluation.variants import Variant

META_ACT: Final = "meta-act"
MULTI_ROUND: Final = "multi-round"
COUNTERFACTUAL: Final = "counterfactual"
ROUND_2: Final = "round-2"
WHOLE_DATASET: Final = "whole-dataset"
LADDER: Final = (META_ACT, MULTI_ROUND, WHOLE_DATASET, COUNTERFACTUAL, ROUND_2)
"""Checkpoints of a ladder, by the folder that each lies in."""

TEMPERATURES: Final = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2)
THRESHOLDS: Final = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""From always to never."""
GROUPS: Final = 10
"""Scenes are told apart by difficulty in so many groups."""

Results = Mapping[Variant, Sequence[SceneResult]]


def ladder_variants(entry: str, controls: Controls, *, route: bool) -> list[Variant]:
    """The rows of one checkpoint of the ladder, without or with the route.

    Args:
        entry: one of `LADDER`.
        controls: of the adaptive rows; the others differ in ``thinking`` alone.
        route: whether it is given.
    """

    def variant(name: str, thinking: Thinking = "never", **changes: Any) -> Variant:
        threshold = controls.think_threshold if thinking == "adaptive" else None
        given = replace(controls, thinking=thinking, think_threshold=threshold)
        return Variant(f"{name}{' + route' if route else ''}", "cf_vla", given, route, **changes)

    if entry == META_ACT:
        no_branch = replace(controls, thinking="adaptive", think_threshold=None)
        return [
            replace(variant("traj-only"), format="traj_only", controls=no_branch),
            variant(META_ACT),
            variant(f"{META_ACT}, expert plan", expert_plan=True),
        ]
    if entry == MULTI_ROUND:
        return [variant(f"{META_ACT}, {MULTI_ROUND}")]
    return [
        variant(f"{entry}, adaptive", thinking="adaptive"),
        variant(f"{entry}, never thinks"),
        variant(f"{entry}, always thinks", thinking="always"),
    ]


def temperature_variants(entry: str, controls: Controls) -> list[Variant]:
    """Figure 8's temperatures; without the route."""
    return [
        Variant(f"{entry}, temperature {value:g}", "cf_vla", replace(controls, temperature=value))
        for value in TEMPERATURES
    ]


def threshold_variants(entry: str, controls: Controls) -> list[Variant]:
    """Think thresholds from often to seldom; without the route."""
    return [
        Variant(f"{entry}, threshold {value:g}", "cf_vla", replace(controls, think_threshold=value))
        for value in THRESHOLDS
    ]


def threshold_results(
    entry: str,
    variants: Sequence[Variant],
    scenes: Sequence[LabelledScene],
    draws: Mapping[tuple[str, str], Sequence[Draw]],
) -> dict[Variant, list[SceneResult]]:
    """Results at think thresholds, without planning anew.

    Args:
        entry: one of `LADDER`.
        variants: which have a ``think_threshold``.
        scenes: that were planned for.
        draws: of the entry's rows that never and that always think, by the row's name and the scene's.
    """
    results: dict[Variant, list[SceneResult]] = {}
    for variant in variants:
        threshold, route = variant.controls.think_threshold, " + route" if variant.route else ""
        assert threshold is not None, variant.name
        found = results[variant] = []
        for labelled in scenes:
            name = labelled.scene.scene_id
            never, always = (draws[f"{entry}, {way} thinks{route}", name] for way in ("never", "always"))
            found.append(evaluate_draws(labelled, at_threshold(never, always, threshold)))
    return results


def at_threshold(never: Sequence[Draw], always: Sequence[Draw], threshold: float) -> list[Draw]:
    """What ``think_threshold`` makes of draws, told from those that may not think and those that must.

    A draw's random numbers depend on seed, draw and position alone: both ways it has written the same when
    it comes to its branch, and behind the branch it goes on as one of the two does.
    """
    return [
        thought if (direct.think_probability or 0.0) > threshold else direct
        for direct, thought in zip(never, always, strict=True)
    ]


@dataclass(frozen=True)
class Difficulty:
    """Scenes of like difficulty: what thinking does there.

    Attributes:
        scenes: how many.
        never_m, adaptive_m: mean minADE without thinking, and where the model decides.
        think_rate: share of draws that thought.
    """

    scenes: int
    never_m: float
    adaptive_m: float
    think_rate: float


def by_difficulty(
    adaptive: Sequence[SceneResult], never: Sequence[SceneResult], groups: int = GROUPS
) -> list[Difficulty]:
    """Scenes from easy to hard, in groups of equal size; fewer groups where there are fewer scenes.

    How hard a scene is, is told by the same model's minADE when it may not think, so that thinking has no
    part in what it is measured by.
    """
    without = {result.scene_id: result.min_ade_m for result in never}
    order = sorted(adaptive, key=lambda result: without[result.scene_id])
    found = []
    for part in np.array_split(np.arange(len(order)), min(groups, len(order))):
        group = [order[place] for place in part]
        found.append(
            Difficulty(
                len(group),
                float(np.mean([without[result.scene_id] for result in group])),
                float(np.mean([result.min_ade_m for result in group])),
                float(np.mean([result.think_rate or 0.0 for result in group])),
            )
        )
    return found


def hard_to_easy(groups: Sequence[Difficulty]) -> float | None:
    """How many times as often the hardest fifth of the scenes is thought about as the easiest one.

    None where the easiest is never thought about, or where a fifth is less than a group.
    """
    fifth = len(groups) // 5
    if not fifth:
        return None
    easiest, hardest = (
        sum(group.scenes * group.think_rate for group in part) for part in (groups[:fifth], groups[-fifth:])
    )
    return hardest / easiest if easiest else None


@dataclass(frozen=True)
class LadderReport:
    """Rows, comparisons and difficulties of a ladder.

    Attributes:
        report: rows of all variants, and comparisons.
        difficulty: by adaptive row, from easy to hard.
    """

    report: EvaluationReport
    difficulty: Mapping[str, Sequence[Difficulty]]

    def to_json(self) -> dict[str, Any]:
        """The table's JSON with ``difficulty`` and ``hard_to_easy`` added."""
        groups = {name: [asdict(group) for group in of] for name, of in self.difficulty.items()}
        ratios = {name: hard_to_easy(of) for name, of in self.difficulty.items()}
        return self.report.to_json() | {"difficulty": groups, "hard_to_easy": ratios}

    def __str__(self) -> str:
        lines = [str(self.report)]
        for name, groups in self.difficulty.items():
            rates = " ".join(f"{group.think_rate:.0%}" for group in groups)
            ratio = hard_to_easy(groups)
            times = "" if ratio is None else f" (hardest : easiest fifth {ratio:.1f})"
            lines.append(f"{name} thinks, from easy to hard scenes: {rates}{times}")
        return "\n".join(lines)


def ladder_report(results: Results) -> LadderReport:
    """What came of a ladder's variants; those that are missing are left out."""
    of = {variant.name: found for variant, found in results.items()}
    rows = [row for variant, found in results.items() for row in variant_rows(variant, found)]
    comparisons = []
    difficulty = {}
    for route in ("", " + route"):
        for name, measure in _COMPARED:
            one, other = (f"{side}{route}" for side in name)
            if one in of and other in of:
                comparisons.append(compare(f"{one} : {other}", of[one], of[other], measure))
        for entry in LADDER:
            adaptive, never = f"{entry}, adaptive{route}", f"{entry}, never thinks{route}"
            if adaptive in of and never in of:
                difficulty[adaptive] = by_difficulty(of[adaptive], of[never])
            if adaptive in of and any(result.thought_iou_first is not None for result in of[adaptive]):
                comparisons.append(revision(adaptive, of[adaptive]))
    return LadderReport(EvaluationReport(tuple(rows), tuple(comparisons)), difficulty)


def write_scenes(results: Results, path: Path) -> None:
    """Write every scene's measures in every row as Parquet, for comparisons that the report does not make."""
    rows = [
        {"row": variant.name} | {name: value for name, value in vars(scene).items() if name != "tags"}
        for variant, scenes in results.items()
        for scene in scenes
    ]
    pq.write_table(pa.Table.from_pylist(rows), path, compression="zstd")


def revision(name: str, results: Sequence[SceneResult]) -> Comparison:
    """Plan IOU behind and before the second look, over the draws that took one."""
    revised = [replace(result, thought_iou_first=result.thought_iou_revised) for result in results]
    return compare(f"{name}: revised : first plan, where it thinks", revised, results, "thought_iou_first")


_MEASURES: Final = ("min_ade_m", "avg_ade_m", "collision_rate")
_COMPARED: Final = (
    ((META_ACT, "traj-only"), "min_ade_m"),
    ((f"{META_ACT}, expert plan", META_ACT), "min_ade_m"),
    *(((f"{META_ACT}, {MULTI_ROUND}", META_ACT), measure) for measure in _MEASURES),
    *(
        ((f"{entry}, adaptive", other), measure)
        for entry in (COUNTERFACTUAL, ROUND_2)
        for other, measure in (
            *((META_ACT, measure) for measure in _MEASURES),
            *((f"{META_ACT}, {MULTI_ROUND}", measure) for measure in _MEASURES),
            (f"{entry}, always thinks", "min_ade_m"),
            *((f"{WHOLE_DATASET}, adaptive", measure) for measure in _MEASURES),
        )
    ),
    *(
        ((f"{entry}, adaptive", f"{entry}, never thinks"), measure)
        for entry in (COUNTERFACTUAL, ROUND_2, WHOLE_DATASET)
        for measure in _MEASURES
    ),
    ((f"{ROUND_2}, adaptive", f"{COUNTERFACTUAL}, adaptive"), "min_ade_m"),
    ((f"{ROUND_2}, adaptive", f"{COUNTERFACTUAL}, adaptive"), "think_rate"),
)
