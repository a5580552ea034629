"""What learning from failures brings, stage by stage: scores, actions, and refinements of what fails.

Source: ELF-VLA's supplement, tables 8 and 10, and section 9.1 on high-level planning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from model.driving.high_level import action_of
from model.driving.lane_graph import LaneGraph
from model.driving.pdm.comfort import Version
from model.driving.pdm.foresight import world_ahead
from model.driving.pdm.judged import THRESHOLD, JudgedPlan
from model.driving.pdm.judging import SceneJudge, judged_plans
from model.driving.pdm.labelled import plans_of
from model.driving.pdm.rule_teacher import feedback_on
from model.driving.pdm.scoring import Others, score
from model.driving.scene import LabelledScene
from model.driving.trajectory import agreed
from model.engines.engine import Controls, Draw, Engine
from model.evaluation.bootstrap import Comparison, compare
from model.evaluation.figures import Columns, FigureRow, figure_table
from model.evaluation.open_loop import SceneResult
from model.evaluation.report import evaluate_variants
from model.evaluation.scores import (
    SceneScore,
    ScoreTable,
    baseline_planners,
    by_scene,
    mean_of,
    scene_scores,
    table_of,
)
from model.evaluation.table import aligned, comparison_cells
from model.evaluation.variants import Variant, over_scenes, planned, request_for
from model.families.family import Attempt, Family
from model.families.registry import OURS, family_named
from model.network.model_card import ModelCard

VERSION: Final[Version] = "v1.1"
"""PDMS: what the paper judges failures by."""


class Formats(NamedTuple):
    """The format of a checkpoint's drafts, and the one that refines them; None where it has none."""

    drafting: Family
    refining: Family | None


def formats_of(card: ModelCard) -> Formats:
    """A checkpoint's first format whose answers can be refined, and what refines them there.

    Raises:
        ValueError: it writes no such format.
    """
    written = [family_named(name) for name in card.formats]
    refining = [family for family in (*written, *OURS.values()) if family.refines]
    for drafting in written:
        for each in refining:
            # A refinement is one more answer in the format of its draft.
            if not drafting.refines and each.format.body == drafting.format.body:
                return Formats(drafting, each if each.name in card.formats else None)
    raise ValueError(f"{card.name} writes no answers that could be refined: it has {', '.join(card.formats)}")


def stage_variants(name: str, card: ModelCard, controls: Controls, seeds: int) -> list[Variant]:
    """What is asked of a stage: its drafts with the route given, once for each seed from 0 on."""
    drafting = formats_of(card).drafting.name
    plain = replace(controls, thinking="adaptive", think_threshold=None)
    return [
        Variant(f"{name}, seed {seed}", drafting, replace(plain, seed=seed), route=True)
        for seed in range(seeds)
    ]


@dataclass(frozen=True)
class StageResult:
    """What a stage's answers to one scene are worth: means over the seeds.

    The answer is the agreed draw of its seed.

    Attributes:
        scene_id, episode_id: the scene's own.
        pdms, epdms: of the answer, by what sub-scores are known.
        draws_pdms: mean over all draws.
        longitudinal, lateral, both: whether the answer's high-level action is the expert's; None where one of
            them is on no lane.
        failed: whether its PDMS is below the threshold.
        noticed: whether automatic feedback, which knows no ground truth, calls a failed answer wrong; None
            where none failed.
        before, after: PDMS of failed answers, and of their refinements; None where none failed, or the
            checkpoint refines nothing.
        refined_pdms: of what would be driven if all answers that automatic feedback calls wrong were refined;
            None where the checkpoint refines nothing.
    """

    scene_id: str
    episode_id: str
    pdms: float | None
    epdms: float | None
    draws_pdms: float
    longitudinal: float | None
    lateral: float | None
    both: float | None
    failed: float
    noticed: float | None
    before: float | None
    after: float | None
    refined_pdms: float | None


@dataclass(frozen=True)
class Stage:
    """A checkpoint, measured.

    Attributes:
        name: of its row.
        threshold, feedback: below which score its training refined, and by whose feedback; None where its
            last stage refined nothing.
        results: a scene each.
        seed_pdms: mean PDMS of each seed.
        scores: of its answers, with all sub-scores.
    """

    name: str
    threshold: float | None
    feedback: str | None
    results: Sequence[StageResult]
    seed_pdms: Sequence[float]
    scores: Mapping[Version, Sequence[SceneScore]]


class _Answer(NamedTuple):
    """The answer of one seed to one scene, judged with and without ground truth."""

    draw: Draw
    score: float
    draws_score: float
    foreseen: JudgedPlan

    @property
    def failed(self) -> bool:
        return self.score < THRESHOLD


async def evaluate_stage(
    engine: Engine,
    scenes: Sequence[LabelledScene],
    variants: Sequence[Variant],
    *,
    name: str,
    judges: Sequence[SceneJudge],
    concurrency: int = 16,
    on_result: Callable[[Variant, SceneResult], None] | None = None,
) -> Stage:
    """Evaluate a started engine of one stage.

    Args:
        engine: started.
        scenes: with a route; of generated episodes, so that extended comfort is known.
        variants: `stage_variants`.
        name: of the stage.
        judges: of the same scenes.
        concurrency: scenes under way at once.
        on_result: called after each scene of each variant, for progress.

    Raises:
        EngineError, RequestError: the engine's.
        ScoreError, SolveError: an answer cannot be scored.
        ValueError: a scene has no route.
    """
    refining = formats_of(engine.card).refining
    draws: dict[str, dict[str, Sequence[Draw]]] = {variant.name: {} for variant in variants}

    def keep(variant: Variant, labelled: LabelledScene, of: Sequence[Draw]) -> None:
        draws[variant.name][labelled.scene.scene_id] = of

    await evaluate_variants(
        engine, scenes, variants, concurrency=concurrency, on_result=on_result, on_draws=keep
    )
    scores, results = [], []
    for variant in variants:
        drawn = draws[variant.name]
        answers = {
            judge.labelled.scene.scene_id: _answer(judge, drawn[judge.labelled.scene.scene_id])
            for judge in judges
        }
        refined: Mapping[str, float] = {}
        if refining is not None:
            refined = await _refined(engine, judges, variant, refining, answers, concurrency)
        planner = by_scene(scenes, {scene_id: each.draw.scored for scene_id, each in answers.items()})
        scores.append(scene_scores(judges, planner))
        results.append(
            [
                _result(judge.labelled, answers[pdms.scene_id], pdms, epdms, refining, refined)
                for judge, pdms, epdms in zip(judges, scores[-1]["v1.1"], scores[-1]["v2.2"], strict=True)
            ]
        )
    threshold, feedback = _refined_in_training(engine.card)
    return Stage(
        name,
        threshold,
        feedback,
        [_over_seeds(of) for of in zip(*results, strict=True)],
        [float(np.mean([each.pdms for each in of if each.pdms is not None])) for of in results],
        {
            version: [SceneScore.mean(of) for of in zip(*(each[version] for each in scores), strict=True)]
            for version in scores[0]
        },
    )


def _answer(judge: SceneJudge, draws: Sequence[Draw]) -> _Answer:
    """The agreed draw, and what automatic feedback goes by."""
    chosen = agreed(np.stack([draw.at_10_hz for draw in draws]))
    worth = judge.scores(plans_of(np.stack([draw.scored for draw in draws])), VERSION).partial_score
    known = judge.labelled.given(route=True, tracks=True)
    world = world_ahead(known.history, known.route, known.tracks or ())
    plan = plans_of(draws[chosen].scored[None])
    foreseen = score(world, plan, VERSION, centre=True)
    [judged] = judged_plans(world, plan, foreseen, Others(), centre=True)
    return _Answer(draws[chosen], float(worth[chosen]), float(worth.mean()), judged)


async def _refined(
    engine: Engine,
    judges: Sequence[SceneJudge],
    variant: Variant,
    refining: Family,
    answers: Mapping[str, _Answer],
    concurrency: int,
) -> dict[str, float]:
    """PDMS of one refinement of each answer that fails or seems to, by automatic feedback."""
    asked = [
        judge
        for judge in judges
        if (answer := answers[judge.labelled.scene.scene_id]).failed or not answer.foreseen.correct
    ]

    async def refine(judge: SceneJudge) -> float:
        answer = answers[judge.labelled.scene.scene_id]
        request = request_for(judge.labelled, variant)
        request = replace(
            request,
            request_id=f"{request.request_id}/refined",
            format=refining.name,
            controls=replace(request.controls, n=1),
            attempt=Attempt(answer.draw.trajectory, str(feedback_on(answer.foreseen))),
        )
        [draw] = await planned(engine, request)
        return float(judge.scores(plans_of(draw.scored[None]), VERSION).partial_score[0])

    worth = await over_scenes(asked, refine, concurrency)
    return {judge.labelled.scene.scene_id: value for judge, value in zip(asked, worth, strict=True)}


def _result(
    labelled: LabelledScene,
    answer: _Answer,
    pdms: SceneScore,
    epdms: SceneScore,
    refining: Family | None,
    refined: Mapping[str, float],
) -> StageResult:
    graph, draw = LaneGraph(labelled.lane_lines), answer.draw
    expert, own = action_of(labelled.future, graph), action_of(draw.trajectory, graph, draw.times_s)
    right: tuple[float | None, float | None] = (None, None)
    if expert is not None and own is not None:
        right = float(own.longitudinal == expert.longitudinal), float(own.lateral == expert.lateral)
    after, driven = refined.get(pdms.scene_id) if answer.failed else None, None
    if refining is not None:
        driven = answer.score if answer.foreseen.correct else refined[pdms.scene_id]
    return StageResult(
        scene_id=pdms.scene_id,
        episode_id=pdms.episode_id,
        pdms=pdms.partial_score,
        epdms=epdms.partial_score,
        draws_pdms=answer.draws_score,
        longitudinal=right[0],
        lateral=right[1],
        both=None if None in right else float(all(right)),
        failed=float(answer.failed),
        noticed=float(not answer.foreseen.correct) if answer.failed else None,
        before=None if after is None else answer.score,
        after=after,
        refined_pdms=driven,
    )


def _over_seeds(results: Sequence[StageResult]) -> StageResult:
    """The mean of a scene's results, of each measure over the seeds that have it."""
    first = results[0]
    means: dict[str, Any] = {
        measure: mean_of([value for each in results if (value := getattr(each, measure)) is not None])
        for measure in MEASURES
    }
    return replace(first, **means)


def _refined_in_training(card: ModelCard) -> tuple[float | None, str | None]:
    """Below which score a checkpoint's last stage refined, and by whose feedback."""
    stages = card.details.get("stages") or [{}]
    refining = (stages[-1].get("outcome") or {}).get("refining")
    return (None, None) if refining is None else (refining["threshold"], refining.get("feedback", "teacher"))


@dataclass(frozen=True)
class FailuresReport:
    """Stages side by side.

    Attributes:
        scores: of the expert, the baselines and all stages.
        stages: in the order of learning.
        comparisons: each stage against the one before it, the last against the first, refinements against
            what they refine.
    """

    scores: ScoreTable
    stages: Sequence[Stage]
    comparisons: Sequence[Comparison]

    @property
    def rows(self) -> list[FigureRow]:
        """The means of each stage."""
        return [FigureRow.of(stage.name, stage.results, MEASURES) for stage in self.stages]

    def to_json(self) -> dict[str, Any]:
        """All of it as JSON's values."""
        stages = [
            row.to_json()
            | {"refined_below": stage.threshold, "feedback": stage.feedback}
            | {"seed_pdms": list(stage.seed_pdms)}
            for stage, row in zip(self.stages, self.rows, strict=True)
        ]
        return {
            "threshold": THRESHOLD,
            "scores": self.scores.to_json(),
            "stages": stages,
            "comparisons": [asdict(comparison) for comparison in self.comparisons],
        }

    def __str__(self) -> str:
        tables = "\n\n".join("\n".join(aligned(lines)) for lines in self._tables())
        return f"{self.scores}\n\n{tables}\n"

    def _tables(self) -> Iterator[list[list[str]]]:
        rows = self.rows
        answers = figure_table("answers", rows, _ANSWER_COLUMNS, MEASURES)
        answers[0].append("by seed")
        for line, stage in zip(answers[1:], self.stages, strict=True):
            line.append(" ".join(f"{value:.3f}" for value in stage.seed_pdms))
        yield answers
        yield figure_table(f"refine@1, below {THRESHOLD:g}", rows, _REFINE_COLUMNS, MEASURES)
        trained = [
            (stage.threshold, replace(row, name=f"{stage.threshold:g}, {stage.feedback}: {stage.name}"))
            for stage, row in zip(self.stages, rows, strict=True)
            if stage.threshold is not None
        ]
        if len(trained) > 1:
            by_threshold = [row for _, row in sorted(trained, key=lambda each: each[0])]
            yield figure_table("refined in training below", by_threshold, _THRESHOLD_COLUMNS, MEASURES)
        if self.comparisons:
            yield [comparison_cells(comparison) for comparison in self.comparisons]


def failures_report(judges: Sequence[SceneJudge], stages: Sequence[Stage]) -> FailuresReport:
    """The report of stages that were evaluated on the scenes of ``judges``, in the order of learning.

    Raises:
        ValueError: there are no scenes.
        ScoreError, SolveError: the expert or a baseline cannot be scored.
    """
    found: dict[str, Mapping[Version, Sequence[SceneScore]]] = {
        name: scene_scores(judges, planner) for name, planner in baseline_planners().items()
    }
    found |= {stage.name: stage.scores for stage in stages}
    return FailuresReport(table_of(judges, found), stages, list(_comparisons(stages)))


def _comparisons(stages: Sequence[Stage]) -> Iterator[Comparison]:
    pairs = list(zip(stages[1:], stages[:-1], strict=True))
    if len(stages) > 2:
        pairs.append((stages[-1], stages[0]))
    for one, other in pairs:
        for measure in ("pdms", "epdms", "both"):
            if _shared(one, other, measure):
                name = f"{one.name} : {other.name}"
                yield compare(name, one.results, other.results, measure)
    for stage in stages:
        if any(each.before is not None for each in stage.results):
            refined = [replace(each, before=each.after) for each in stage.results]
            name = f"{stage.name}, failed: refined : draft"
            yield replace(compare(name, refined, stage.results, "before"), measure="pdms")
        if any(each.refined_pdms is not None for each in stage.results):
            driven = [replace(each, pdms=each.refined_pdms) for each in stage.results]
            yield compare(f"{stage.name}, all: refined where noticed : draft", driven, stage.results, "pdms")


def _shared(one: Stage, other: Stage, measure: str) -> bool:
    """Whether some scene has a measure in both."""
    has = [
        {each.scene_id for each in stage.results if getattr(each, measure) is not None}
        for stage in (one, other)
    ]
    return bool(has[0] & has[1])


_SCORE: Final = "{:.3f}"
_SHARE: Final = "{:.1%}"
_ANSWER_COLUMNS: Final[Columns] = {
    "pdms": ("PDMS", _SCORE),
    "draws_pdms": ("of all draws", _SCORE),
    "epdms": ("EPDMS", _SCORE),
    "longitudinal": ("speed right", _SHARE),
    "lateral": ("direction right", _SHARE),
    "both": ("both right", _SHARE),
}
_REFINE_COLUMNS: Final[Columns] = {
    "failed": ("fails", _SHARE),
    "noticed": ("noticed", _SHARE),
    "before": ("before", _SCORE),
    "after": ("after", _SCORE),
    "refined_pdms": ("PDMS, refined where noticed", _SCORE),
}
_THRESHOLD_COLUMNS: Final[Columns] = {each: _ANSWER_COLUMNS[each] for each in ("pdms", "epdms", "both")}
MEASURES: Final = (*_ANSWER_COLUMNS, *_REFINE_COLUMNS)
"""Measures of `StageResult`."""
