"""The whole open-loop evaluation of a checkpoint: baselines, variants, subgroups and what is compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

from looktwice.model.driving.lead import LEAD_WITHIN_M
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import FloatArray, path_length
from looktwice.model.engines.engine import Draw, Engine
from looktwice.model.evaluation.bootstrap import Comparison, compare
from looktwice.model.evaluation.open_loop import (
    EXPERT,
    LEAD_WITHIN_S,
    MEASURES,
    SceneResult,
    evaluate_baselines,
    evaluate_trajectories,
)
from looktwice.model.evaluation.table import VariantRow, format_table, to_json
from looktwice.model.evaluation.variants import Variant, evaluate_engine
from looktwice.model.families.registry import family_named

LEAD_SUBGROUP = f"lead within {LEAD_WITHIN_M:.0f} m"
SOON_SUBGROUP = f"lead within {LEAD_WITHIN_S:.0f} s"


@dataclass(frozen=True)
class EvaluationReport:
    """Rows and comparisons of one evaluation.

    Attributes:
        rows, comparisons: of the table.
        speed_response: by variant or planner, and by factor of speed, how much of the change of speed its
            path follows: 1 copies it, 0 does not mind.
    """

    rows: tuple[VariantRow, ...]
    comparisons: tuple[Comparison, ...]
    speed_response: Mapping[str, Mapping[float, float]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """See `looktwice.model.evaluation.table.to_json`; factors of speed are told as text."""
        responses = {
            name: {f"{factor:g}": value for factor, value in of.items()}
            for name, of in self.speed_response.items()
        }
        return to_json(self.rows, self.comparisons) | {"speed_response": responses}

    def __str__(self) -> str:
        lines = [
            f"{name}: speed response "
            + ", ".join(f"{value:.2f} at x {factor:g}" for factor, value in of.items())
            for name, of in self.speed_response.items()
        ]
        return format_table(self.rows, self.comparisons) + "".join(f"{line}\n" for line in lines)


async def evaluate_checkpoint(
    engine: Engine,
    scenes: Sequence[LabelledScene],
    variants: Sequence[Variant],
    *,
    concurrency: int = 16,
    on_result: Callable[[Variant, SceneResult], None] | None = None,
    planners: Mapping[str, Callable[[LabelledScene], FloatArray]] = MappingProxyType({}),
) -> EvaluationReport:
    """Evaluate a started engine in every variant, the expert and all baselines, on the same scenes.

    Args:
        engine: started.
        scenes: at least one.
        variants: see `standard_variants`.
        concurrency: scenes under way at once.
        on_result: called after each scene of each variant, for progress.
        planners: that get a row beside the baselines.

    Raises:
        EngineError, RequestError, ValueError: see `evaluate_engine`.
    """
    baselines = evaluate_baselines(scenes)
    for name, planner in planners.items():
        baselines[name] = [evaluate_trajectories(each, planner(each)[None]) for each in scenes]
    results = await evaluate_variants(engine, scenes, variants, concurrency=concurrency, on_result=on_result)
    rows = [row for name, of in baselines.items() for row in _rows(name, of)]
    rows += [row for variant, of in results.items() for row in variant_rows(variant, of)]
    speeds = sorted({variant.speed for variant in variants} - {1.0})
    responses = {
        name: {
            times: _response(_path_m(planner, scenes, times), _all_m(baselines[name]), times)
            for times in speeds
        }
        for name, planner in planners.items()
        if speeds
    }
    responses |= speed_responses(results)
    return EvaluationReport(tuple(rows), tuple(compare_variants(baselines, results)), responses)


def speed_responses(results: Mapping[Variant, Sequence[SceneResult]]) -> dict[str, dict[float, float]]:
    """How much of a change of speed the paths of variants follow; see `EvaluationReport.speed_response`."""
    path_m = {variant: _all_m(of) for variant, of in results.items()}
    responses: dict[str, dict[float, float]] = {}
    for variant, length_m in path_m.items():
        free = _free(variant, results)
        if variant.speed != 1.0 and free is not None:
            response = _response(length_m, path_m[free], variant.speed)
            responses.setdefault(free.name, {})[variant.speed] = response
    return responses


def _response(path_m: float, usual_m: float, times: float) -> float:
    """How much of a change of speed, so many times the usual one, paths follow that are so long in all."""
    return (path_m / usual_m - 1) / (times - 1)


def _path_m(
    planner: Callable[[LabelledScene], FloatArray], scenes: Sequence[LabelledScene], times: float
) -> float:
    """How long a planner's paths are in all, at so many times the speed of scenes."""
    return sum(path_length(planner(each.at_speed(times))) for each in scenes)


def _all_m(results: Sequence[SceneResult]) -> float:
    """How long the paths of results are in all."""
    return sum(result.path_m for result in results)


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


def variant_rows(variant: Variant, results: Sequence[SceneResult]) -> list[VariantRow]:
    """A variant's rows: over all scenes, and over those with a lead vehicle close by."""
    controls = variant.controls
    return _rows(variant.name, results, thinking=controls.thinking, n=controls.n, route=variant.route)


def _rows(name: str, results: Sequence[SceneResult], **about: Any) -> list[VariantRow]:
    """A variant's row over all scenes, and those over scenes with a lead vehicle close by or soon met."""
    rows = [VariantRow.of(name, results, MEASURES, **about)]
    for subgroup, of in ((LEAD_SUBGROUP, _with_lead(results)), (SOON_SUBGROUP, _soon(results))):
        if of:
            rows.append(VariantRow.of(name, of, MEASURES, subgroup=subgroup, **about))
    return rows


def compare_variants(
    baselines: Mapping[str, Sequence[SceneResult]], results: Mapping[Variant, Sequence[SceneResult]]
) -> list[Comparison]:
    """What should differ, pair by pair.

    Of the draw that is driven by: free planning against every baseline but the expert. Of minADE: against
    bare trajectories, and given the expert's plan against free. Of avgADE: against bare trajectories, and
    shuffled images against free. Of path lengths: shuffled against free, where a lead is near.
    """
    comparisons = []
    for variant, of in results.items():
        free = _free(variant, results)
        if free is not None and variant.expert_plan:
            comparisons.append(compare(f"{variant.name} : {free.name}", of, results[free]))
        if free is not None and variant.shuffled_images:
            name = f"{variant.name} : {free.name}"
            comparisons.append(compare(name, of, results[free], "avg_ade_m"))
            if close := _with_lead(of):
                lead = f"{name} [{LEAD_SUBGROUP}]"
                comparisons.append(compare(lead, close, _with_lead(results[free]), "avg_ade_m"))
            if soon := _soon(of):
                comparisons.append(compare(f"{name} [{SOON_SUBGROUP}]", soon, _soon(results[free]), "path_m"))
        if variant != replace(variant, expert_plan=False, shuffled_images=False, speed=1.0):
            continue
        comparisons += [
            compare(f"{variant.name} : {name}", of, baseline, "agreed_ade_m")
            for name, baseline in baselines.items()
            if name != EXPERT
        ]
        for other in results:
            plain = family_named(other.format).bare and not other.shuffled_images
            given = (other.route, other.tracks) == (variant.route, variant.tracks)
            if not family_named(variant.format).bare and plain and given:
                name = f"{variant.name} : {other.name}"
                comparisons += [
                    compare(name, of, results[other], measure) for measure in ("min_ade_m", "avg_ade_m")
                ]
    return comparisons


def _free(variant: Variant, results: Mapping[Variant, Sequence[SceneResult]]) -> Variant | None:
    """The variant that differs from ``variant`` only in what is changed about its scenes; None for itself."""
    plain = replace(variant, name="", expert_plan=False, shuffled_images=False, speed=1.0, greedy=False)
    for other in results:
        if other is not variant and replace(other, name="", greedy=False) == plain:
            return other
    return None


def _with_lead(results: Sequence[SceneResult]) -> list[SceneResult]:
    return [result for result in results if result.lead_close]


def _soon(results: Sequence[SceneResult]) -> list[SceneResult]:
    return [result for result in results if result.lead_soon]
