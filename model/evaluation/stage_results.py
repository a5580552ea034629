"""What learning from failures brings, stage by stage: scores, actions, and refinements of what fails.

Source: ELF-VLA's supplement, tables 8 and 10, and section 9.1 on high-level planning.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, NamedTuple

import numpy as np

from looktwice.model.driving.high_level import action_of
from looktwice.model.driving.lane_graph import LaneGraph
from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.foresight import world_ahead
from looktwice.model.driving.pdm.judged import THRESHOLD, JudgedPlan
from looktwice.model.driving.pdm.judging import SceneJudge, judged_plans
from looktwice.model.driving.pdm.labelled import plans_of
from looktwice.model.driving.pdm.rule_teacher import feedback_on
from looktwice.model.driving.pdm.scoring import Others, score
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import agreed
from looktwice.model.engines.engine import Controls, Draw, Engine, PlanRequest
from looktwice.model.evaluation.open_loop import SceneResult
from looktwice.model.evaluation.report import evaluate_variants
from looktwice.model.evaluation.scores import (
    SceneScore,
    by_scene,
    mean_of,
    scene_scores,
)
from looktwice.model.evaluation.variants import Variant, over_scenes, planned, request_for
from looktwice.model.families.family import Attempt, Family
from looktwice.model.families.registry import OURS, family_named
from looktwice.model.network.model_card import ModelCard

VERSION: Final[Version] = "v1.1"
"""PDMS: what the paper judges failures by."""
_OTHER_SEED: Final = 1 << 40
"""Beside the seeds of all variants and scenes, which have fewer bits."""


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
        again: PDMS of one more draw for each failed answer, without feedback; None as of those.
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
    again: float | None
    refined_pdms: float | None


MEASURES: Final = tuple(each.name for each in fields(StageResult) if not each.name.endswith("_id"))
"""What is averaged over scenes."""


@dataclass(frozen=True)
class MeasuredStage:
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


class _SecondAnswers(NamedTuple):
    """PDMS by scene of what comes second: refinements, and new draws without feedback."""

    refined: Mapping[str, float]
    again: Mapping[str, float]


class _JudgedAnswer(NamedTuple):
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
) -> MeasuredStage:
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
        second = None
        if refining is not None:
            second = await _second_answers(engine, judges, variant, refining, answers, concurrency)
        planner = by_scene(scenes, {scene_id: each.draw.scored for scene_id, each in answers.items()})
        scores.append(scene_scores(judges, planner))
        results.append(
            [
                _result(judge.labelled, answers[pdms.scene_id], pdms, epdms, second)
                for judge, pdms, epdms in zip(judges, scores[-1]["v1.1"], scores[-1]["v2.2"], strict=True)
            ]
        )
    threshold, feedback = _refined_in_training(engine.card)
    return MeasuredStage(
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


def _answer(judge: SceneJudge, draws: Sequence[Draw]) -> _JudgedAnswer:
    """The agreed draw, and what automatic feedback goes by."""
    chosen = agreed(np.stack([draw.at_10_hz for draw in draws]))
    worth = judge.scores(plans_of(np.stack([draw.scored for draw in draws])), VERSION).partial_score
    known = judge.labelled.given(route=True, tracks=True)
    world = world_ahead(known.history, known.route, known.tracks or ())
    plan = plans_of(draws[chosen].scored[None])
    foreseen = score(world, plan, VERSION, centre=True)
    [judged] = judged_plans(world, plan, foreseen, Others(), centre=True)
    return _JudgedAnswer(draws[chosen], float(worth[chosen]), float(worth.mean()), judged)


async def _second_answers(
    engine: Engine,
    judges: Sequence[SceneJudge],
    variant: Variant,
    refining: Family,
    answers: Mapping[str, _JudgedAnswer],
    concurrency: int,
) -> _SecondAnswers:
    """One refinement of each answer that fails or seems to, and one more draw for each that fails."""

    def refinement(asked: PlanRequest, answer: _JudgedAnswer) -> PlanRequest:
        return replace(
            asked,
            request_id=f"{asked.request_id}/refined",
            format=refining.name,
            controls=replace(asked.controls, n=1),
            attempt=Attempt(answer.draw.trajectory, str(feedback_on(answer.foreseen))),
        )

    def one_more(asked: PlanRequest, answer: _JudgedAnswer) -> PlanRequest:
        controls = replace(asked.controls, n=1, seed=asked.controls.seed ^ _OTHER_SEED)
        return replace(asked, request_id=f"{asked.request_id}/again", controls=controls)

    async def worth(
        of: Sequence[SceneJudge], request: Callable[[PlanRequest, _JudgedAnswer], PlanRequest]
    ) -> dict[str, float]:
        async def one(judge: SceneJudge) -> float:
            answer = answers[judge.labelled.scene.scene_id]
            [draw] = await planned(engine, request(request_for(judge.labelled, variant), answer))
            return float(judge.scores(plans_of(draw.scored[None]), VERSION).partial_score[0])

        found = await over_scenes(of, one, concurrency)
        return {judge.labelled.scene.scene_id: value for judge, value in zip(of, found, strict=True)}

    judged = [(judge, answers[judge.labelled.scene.scene_id]) for judge in judges]
    seems_wrong = [judge for judge, answer in judged if answer.failed or not answer.foreseen.correct]
    failed = [judge for judge, answer in judged if answer.failed]
    return _SecondAnswers(await worth(seems_wrong, refinement), await worth(failed, one_more))


def _result(
    labelled: LabelledScene,
    answer: _JudgedAnswer,
    pdms: SceneScore,
    epdms: SceneScore,
    second: _SecondAnswers | None,
) -> StageResult:
    graph, draw = LaneGraph(labelled.lane_lines), answer.draw
    expert, own = action_of(labelled.future, graph), action_of(draw.trajectory, graph, draw.times_s)
    right: tuple[float | None, float | None] = (None, None)
    if expert is not None and own is not None:
        right = float(own.longitudinal == expert.longitudinal), float(own.lateral == expert.lateral)
    before, after, again, driven = None, None, None, None
    if second is not None:
        driven = answer.score if answer.foreseen.correct else second.refined[pdms.scene_id]
        if answer.failed:
            before = answer.score
            after, again = second.refined[pdms.scene_id], second.again[pdms.scene_id]
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
        before=before,
        after=after,
        again=again,
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
