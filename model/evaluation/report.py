"""The whole open-loop evaluation of a checkpoint: baselines, variants, subgroups and what is compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from model.driving.lead import LEAD_WITHIN_M
from model.driving.scene import LabelledScene
from model.engines.engine import Draw, Engine
from model.evaluation.bootstrap import Comparison, compare
from model.evaluation.open_loop import SceneResult, evaluate_baselines
from model.evaluation.table import Row, format_table, to_json
from model.evaluation.variants import Variant, evaluate_engine

LEAD_SUBGROUP = f"lead within {LEAD_WITHIN_M:.0f} m"


@dataclass(frozen=True)
class Report:
    """Rows and comparisons of one evaluation."""

    rows: tuple[Row, ...]
    comparisons: tuple[Comparison, ...]

    def to_json(self) -> dict[str, Any]:
        """See `model.evaluation.table.to_json`."""
        return to_json(self.rows, self.comparisons)

    def __str__(self) -> str:
        return format_table(self.rows, self.comparisons)


async def evaluate_checkpoint(
    engine: Engine,
    scenes: Sequence[LabelledScene],
    variants: Sequence[Variant],
    *,
    concurrency: int = 16,
    on_result: Callable[[Variant, SceneResult], None] | None = None,
) -> Report:
    """Evaluate a started engine in every variant, and the kinematic baselines, on the same scenes.

    Args:
        engine: started.
        scenes: at least one.
        variants: see `standard_variants`.
        concurrency: scenes under way at once.
        on_result: called after each scene of each variant, for progress.

    Raises:
        EngineError, RequestError, ValueError: see `evaluate_engine`.
    """
    baselines = evaluate_baselines(scenes)
    results = await evaluate_variants(engine, scenes, variants, concurrency=concurrency, on_result=on_result)
    rows = [row for name, of in baselines.items() for row in _rows(name, of)]
    rows += [row for variant, of in results.items() for row in variant_rows(variant, of)]
    return Report(tuple(rows), tuple(compare_variants(baselines, results)))


async def evaluate_variants(
    engine: Engine,
    scenes: Sequence[LabelledScene],
    variants: Sequence[Variant],
    *,
    concurrency: int = 16,
    on_result: Callable[[Variant, SceneResult], None] | None = None,
    on_draws: Callable[[Variant, LabelledScene, Sequence[Draw]], None] | None = None,
) -> dict[Variant, list[SceneResult]]:
    """Results of a started engine in every variant; see `evaluate_checkpoint` and `evaluate_engine`."""
    results = {}
    for variant in variants:
        results[variant] = await evaluate_engine(
            engine,
            scenes,
            variant,
            concurrency=concurrency,
            on_result=on_result and partial(on_result, variant),
            on_draws=on_draws and partial(on_draws, variant),
        )
    return results


def variant_rows(variant: Variant, results: Sequence[SceneResult]) -> list[Row]:
    """A variant's rows: over all scenes, and over those with a lead vehicle close by."""
    controls = variant.controls
    return _rows(variant.name, results, thinking=controls.thinking, n=controls.n, route=variant.route)


def _rows(name: str, results: Sequence[SceneResult], **about: Any) -> list[Row]:
    """A variant's row over all scenes, and one over those with a lead vehicle close by."""
    rows = [Row.from_results(name, results, **about)]
    if close := _with_lead(results):
        rows.append(Row.from_results(name, close, subgroup=LEAD_SUBGROUP, **about))
    return rows


def compare_variants(
    baselines: Mapping[str, Sequence[SceneResult]], results: Mapping[Variant, Sequence[SceneResult]]
) -> list[Comparison]:
    """minADE of what should differ, pair by pair.

    Free planning against the best baseline and against the format without plans; given the expert's plan
    against free; shuffled images against free, also where a lead vehicle is close by.
    """
    best = min(baselines, key=lambda name: sum(result.min_ade_m for result in baselines[name]))
    comparisons = []
    for variant, of in results.items():
        if variant.expert_plan or variant.shuffled_images:
            free = _free(variant, results)
            if free is None:
                continue
            comparisons.append(compare(f"{variant.name} : {free.name}", of, results[free]))
            if variant.shuffled_images and (close := _with_lead(of)):
                comparisons.append(
                    compare(
                        f"{variant.name} : {free.name} [{LEAD_SUBGROUP}]", close, _with_lead(results[free])
                    )
                )
            continue
        comparisons.append(compare(f"{variant.name} : {best}", of, baselines[best]))
        for other in results:
            plain = other.format == "traj_only" and not other.shuffled_images
            if variant.format != "traj_only" and plain and other.route == variant.route:
                comparisons.append(compare(f"{variant.name} : {other.name}", of, results[other]))
    return comparisons


def _free(variant: Variant, results: Mapping[Variant, Sequence[SceneResult]]) -> Variant | None:
    """The variant that differs from ``variant`` only in what it is given."""
    for other in results:
        alike = (other.format, other.controls, other.route) == (
            variant.format,
            variant.controls,
            variant.route,
        )
        if alike and not other.expert_plan and not other.shuffled_images:
            return other
    return None


def _with_lead(results: Sequence[SceneResult]) -> list[SceneResult]:
    return [result for result in results if result.lead_close]
