"""Open-loop results of single scenes: what n draws, or a kinematic baseline, make of a labelled scene.

The measures are those of CF-VLA's table 1; `looktwice.model.evaluation.table` averages them over scenes.
Trajectories with times of their own are compared with the expert at these times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from looktwice.model.driving.agreement import reason_and_change, reason_and_view, trajectory_iou
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.lead import lead_within
from looktwice.model.driving.metrics import collides, common, displacement_errors, leaves_road
from looktwice.model.driving.plan import Plan, plan_iou
from looktwice.model.driving.scene import LabelledScene, Tag
from looktwice.model.driving.trajectory import (
    TEN_HZ_S,
    FloatArray,
    agreed,
    at_10_hz,
    constant_turn_rate,
    constant_velocity,
    path_length,
    present_speed,
)
from looktwice.model.driving.view import Surroundings, view_of
from looktwice.model.engines.engine import Draw
from looktwice.model.evaluation.words import unknown_words

MEASURES: Final = (
    "agreed_ade_m",
    "greedy_ade_m",
    "avg_ade_m",
    "min_ade_m",
    "path_m",
    "path_error_m",
    "min_fde_m",
    "avg_fde_m",
    "corner_distance_m",
    "collision_rate",
    "off_road_rate",
    "agreement_plan_trajectory",
    "agreement_reason_change",
    "agreement_reason_view",
    "unknown_words",
    "plan_iou_first",
    "plan_iou_best",
    "plan_iou_revised",
    "output_tokens",
    "think_rate",
    "thought_iou_first",
    "thought_iou_revised",
)
"""Fields of `SceneResult` that are averaged over scenes, in the table's order."""

BASELINES: Final[Mapping[str, Callable[[FloatArray], FloatArray]]] = {
    "constant velocity": constant_velocity,
    "constant turn rate": constant_turn_rate,
}


LEAD_WITHIN_S: Final = 4.0
"""A lead vehicle this near decides how fast one may go."""


EXPERT: Final = "expert"


@dataclass(frozen=True)
class SceneResult:
    """What one scene's draws are worth. A measure is None where it has no meaning.

    Attributes:
        scene_id, episode_id, tags: the scene's own.
        lead_close: a vehicle is in the ego's way close by, see `lead_within`.
        lead_soon: one is nearer than `LEAD_WITHIN_S` at the present speed.
        agreed_ade_m: average displacement error of the draw that is driven by, see `agreed`.
        greedy_ade_m: that of the likeliest response; None where nobody asked for it.
        path_m: length of the draw that is driven by.
        path_error_m: by how much that is longer than the expert's.
        min_ade_m, avg_ade_m, min_fde_m, avg_fde_m, corner_distance_m: see `DisplacementErrors`.
        collision_rate: share of draws that meet another agent or obstacle within 5 s.
        off_road_rate: share of draws that leave the road; None where no drivable area is known.
        agreement_plan_trajectory: IOU of the plan that a draw ends with and the plan that its trajectory
            carries out (`looktwice.model.driving.agreement`), mean; None without plans.
        agreement_reason_change: share of the reasonings whose revised plan changes as they ask for.
        agreement_reason_view: share of the reasonings that name nothing but what is in view, in its place.
        unknown_words: words of a reasoning that are none (`looktwice.model.evaluation.words`), mean.
        plan_iou_first: IOU of the first plan with the expert's, mean over draws; None without plans.
        plan_iou_best: the same, best of the draws.
        plan_iou_revised: IOU of the plan a draw ends with (the first one, where it did not reflect), mean.
        output_tokens: tokens per draw, forced ones included.
        think_rate: share of draws that reflected; None where the format has no branch.
        thought_iou_first, thought_iou_revised: IOU of the first and of the revised plan with the expert's,
            mean over the draws that reflected; None where none did.
    """

    scene_id: str
    episode_id: str
    tags: frozenset[Tag]
    lead_close: bool
    lead_soon: bool
    agreed_ade_m: float
    avg_ade_m: float
    min_ade_m: float
    path_m: float
    path_error_m: float
    min_fde_m: float
    avg_fde_m: float
    corner_distance_m: float
    collision_rate: float
    off_road_rate: float | None
    greedy_ade_m: float | None = None
    agreement_plan_trajectory: float | None = None
    agreement_reason_change: float | None = None
    agreement_reason_view: float | None = None
    unknown_words: float | None = None
    plan_iou_first: float | None = None
    plan_iou_best: float | None = None
    plan_iou_revised: float | None = None
    output_tokens: float | None = None
    think_rate: float | None = None
    thought_iou_first: float | None = None
    thought_iou_revised: float | None = None


def evaluate_trajectories(
    labelled: LabelledScene, trajectories: FloatArray, times_s: Sequence[float] = TEN_HZ_S
) -> SceneResult:
    """The result of bare trajectories [n, t, 4] with poses at ``times_s``.

    Errors are taken at these times, everything else at 10 Hz, both up to the last pose.
    """
    errors = displacement_errors(*common(trajectories, labelled.future, times_s))
    chosen = agreed(trajectories)
    dense = np.stack([at_10_hz(trajectory, times_s) for trajectory in trajectories])
    path_m = path_length(dense[chosen])
    soon_m = LEAD_WITHIN_S * max(0.0, present_speed(labelled.scene.history))
    return SceneResult(
        scene_id=labelled.scene.scene_id,
        episode_id=labelled.episode_id,
        tags=labelled.tags,
        lead_close=lead_within(labelled),
        lead_soon=lead_within(labelled, soon_m),
        agreed_ade_m=_ade_m(labelled, trajectories[chosen], times_s),
        avg_ade_m=errors.avg_ade_m,
        min_ade_m=errors.min_ade_m,
        path_m=path_m,
        path_error_m=path_m - path_length(labelled.future[: dense.shape[1]]),
        min_fde_m=errors.min_fde_m,
        avg_fde_m=errors.avg_fde_m,
        corner_distance_m=errors.corner_distance_m,
        collision_rate=float(collides(dense, labelled.agents).mean()),
        off_road_rate=float(leaves_road(dense, labelled.drivable).mean()) if labelled.drivable else None,
    )


def _ade_m(labelled: LabelledScene, trajectory: FloatArray, times_s: Sequence[float]) -> float:
    return displacement_errors(*common(trajectory[None], labelled.future, times_s)).min_ade_m


def evaluate_draws(labelled: LabelledScene, draws: Sequence[Draw], greedy: Draw | None = None) -> SceneResult:
    """The result of a scene's draws: trajectories, plans, tokens and thinking.

    Args:
        labelled: the scene.
        draws: at least one.
        greedy: the likeliest response, where it was asked for.

    Raises:
        ValueError: no draws.
    """
    if not draws:
        raise ValueError(f"scene {labelled.scene.scene_id} has no draws to evaluate")
    expert = expert_plan(labelled)
    first = [iou_with_expert(draw.plan, expert) for draw in draws if draw.plan is not None]
    last = [
        iou_with_expert(draw.revised_plan or draw.plan, expert) for draw in draws if draw.plan is not None
    ]
    thought = [
        (iou_with_expert(draw.plan, expert), iou_with_expert(draw.revised_plan, expert))
        for draw in draws
        if draw.plan is not None and draw.revised_plan is not None
    ]
    followed = [
        trajectory_iou(draw.revised_plan or draw.plan, draw.at_10_hz, labelled.scene.history)
        for draw in draws
    ]
    branching = [draw for draw in draws if draw.branch is not None]
    change, seen, unknown = _words(labelled, draws)
    return replace(
        evaluate_trajectories(labelled, np.stack([draw.trajectory for draw in draws]), draws[0].times_s),
        greedy_ade_m=None if greedy is None else _ade_m(labelled, greedy.trajectory, greedy.times_s),
        agreement_plan_trajectory=_mean([iou for iou in followed if iou is not None]),
        agreement_reason_change=change,
        agreement_reason_view=seen,
        unknown_words=unknown,
        plan_iou_first=_mean(first),
        plan_iou_best=max(first, default=None),
        plan_iou_revised=_mean(last),
        output_tokens=_mean([float(sum(draw.tokens.values())) for draw in draws]),
        think_rate=_mean([float(draw.looked_twice) for draw in branching]),
        thought_iou_first=_mean([first for first, _ in thought]),
        thought_iou_revised=_mean([revised for _, revised in thought]),
    )


def _words(labelled: LabelledScene, draws: Sequence[Draw]) -> tuple[float | None, float | None, float | None]:
    """How far the reasonings of some draws agree with change and view, and their unknown words."""
    view = view_of(labelled.scene, Surroundings.of(labelled))
    change, seen, unknown = list[float](), list[float](), list[float]()
    for draw in draws:
        if draw.plan is None or draw.thinking is None or draw.revised_plan is None:
            continue
        unknown.append(float(len(unknown_words(draw.thinking))))
        if (agrees := reason_and_change(draw.thinking, draw.plan, draw.revised_plan)) is not None:
            change.append(float(agrees))
        if (is_there := reason_and_view(draw.thinking, view)) is not None:
            seen.append(float(is_there))
    return _mean(change), _mean(seen), _mean(unknown)


def evaluate_baselines(scenes: Iterable[LabelledScene]) -> dict[str, list[SceneResult]]:
    """Results of each kinematic baseline (`BASELINES`) and of the expert itself, one trajectory a scene."""
    results: dict[str, list[SceneResult]] = {name: [] for name in (EXPERT, *BASELINES)}
    for labelled in scenes:
        results[EXPERT].append(evaluate_trajectories(labelled, labelled.future[None]))
        for name, baseline in BASELINES.items():
            trajectory = baseline(labelled.scene.history)
            results[name].append(evaluate_trajectories(labelled, trajectory[None]))
    return results


def iou_with_expert(plan: Plan, expert: Plan) -> float:
    """IOU over the groups whose truth is known: without lanes, nobody knows whether the lane was kept."""
    known = {group: track for group, track in plan.tracks() if expert.track(group) is not None}
    return plan_iou(Plan(**known), expert)


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
