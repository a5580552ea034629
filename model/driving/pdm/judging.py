"""From scores to judged plans: facts, courses and waypoints of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.course import course_of
from looktwice.model.driving.pdm.failures import facts_of
from looktwice.model.driving.pdm.judged import THRESHOLD, JudgedPlan, Waypoint
from looktwice.model.driving.pdm.labelled import plans_of, world_of
from looktwice.model.driving.pdm.scoring import Others, Scores, score
from looktwice.model.driving.pdm.world import ACCELERATION, Array, ScoreError, World
from looktwice.model.driving.scene import LabelledScene

_EVERY: Final = {8: 1, 64: 5}
"""Waypoints are told every half a second."""
_WAYPOINTS: Final = 8
SCORE_DECIMALS: Final = 6


@dataclass(frozen=True)
class PlanExplanation:
    """What a planner says of one plan: in words, and how it came to it; None where it says nothing."""

    words: str | None = None
    think: str | None = None


_NOTHING: Final = PlanExplanation()


def judged_plans(
    world: World,
    plans: Array,
    scores: Scores,
    others: Others,
    *,
    threshold: float = THRESHOLD,
    truth: Array | None = None,
    said: Sequence[PlanExplanation] | None = None,
    command: str | None = None,
    centre: bool = False,
) -> list[JudgedPlan]:
    """Each plan with what a teacher is told of it.

    Args:
        world, plans, others: as they were scored.
        scores: what came of it.
        threshold: from which score on a plan is correct, 0 to 1.
        truth: [8, 3] or [64, 3], what the human drove.
        said: of each plan.
        command: where the ego is to go.
        centre: whether poses are those of the box's centre instead of the rear axle.

    Raises:
        ScoreError: a plan of which no sub-score is known.
    """
    if not 0.0 <= threshold <= 1.0:
        raise ScoreError("threshold", f"lies between 0 and 1, not at {threshold}")
    facts = facts_of(world, scores, others)
    ahead_m = world.vehicle.centre_m if centre else 0.0
    true_course = None if truth is None else course_of(truth, world.ego, ahead_m)
    judged = []
    for row, plan in enumerate(plans):
        whole, partial = float(scores.score[row]), float(scores.partial_score[row])
        if np.isnan(partial):
            raise ScoreError(f"plans/{row}", "cannot be judged: the labels lack what any sub-score needs")
        own = _NOTHING if said is None else said[row]
        judged.append(
            JudgedPlan(
                version=scores.version,
                # What is told is what is judged: a score that reads 0.8 is not below 0.8.
                score=round(partial if np.isnan(whole) else whole, SCORE_DECIMALS),
                is_partial=bool(np.isnan(whole)),
                threshold=threshold,
                sub_scores={
                    name: None if values is None or np.isnan(values[row]) else float(values[row])
                    for name, values in scores.sub_scores.items()
                },
                facts=facts[row],
                acceleration_mps2=float(world.ego[ACCELERATION]),
                course=course_of(plan, world.ego, ahead_m),
                waypoints=_waypoints(plan),
                true_course=true_course,
                true_waypoints=() if truth is None else _waypoints(truth),
                command=command,
                words=own.words,
                think=own.think,
            )
        )
    return judged


class SceneJudge:
    """Judges plans of the box's centre in a labelled scene, measured against its expert.

    The scene's world is made once, for all plans that are judged there.

    Args:
        labelled: the scene with what really came.
    """

    def __init__(self, labelled: LabelledScene) -> None:
        self.labelled = labelled
        self._expert = plans_of(labelled.future)
        self._others = Others(self._expert, "expert")

    @cached_property
    def _world(self) -> World:
        return world_of(self.labelled)

    def scores(
        self, plans: Array, version: Version, *, previous: Array | None = None, forgive: bool = False
    ) -> Scores:
        """Of plans [n, 8, 3] or [n, 64, 3].

        Args:
            plans: to be scored.
            version: whose rules.
            previous: [41, 11], simulated states of the plan made half a second earlier, where it is known.
            forgive: what the expert fails at too (v2.2).

        Raises:
            ScoreError, SolveError: see `score`.
        """
        others = replace(self._others, previous=previous, human=self._expert if forgive else None)
        return score(self._world, plans, version, others, centre=True)

    def judged(
        self,
        plans: Array,
        version: Version,
        threshold: float = THRESHOLD,
        said: Sequence[PlanExplanation] | None = None,
    ) -> list[JudgedPlan]:
        """The same plans with what a teacher is told of each, in a careful world.

        Raises:
            ScoreError, SolveError: see `score` and `judged_plans`.
        """
        world = replace(self._world, careful=True)
        return judged_plans(
            world,
            plans,
            score(world, plans, version, self._others, centre=True),
            self._others,
            threshold=threshold,
            truth=self._expert,
            said=said,
            centre=True,
        )


def judged_in_scene(
    labelled: LabelledScene,
    plans: Array,
    version: Version,
    threshold: float = THRESHOLD,
    said: Sequence[PlanExplanation] | None = None,
) -> list[JudgedPlan]:
    """What `SceneJudge` says of the plans of one scene, judged once."""
    return SceneJudge(labelled).judged(plans, version, threshold, said)


def _waypoints(plan: Array) -> tuple[Waypoint, ...]:
    every = _EVERY[len(plan)]
    told = plan[every - 1 :: every][:_WAYPOINTS]
    return tuple(
        Waypoint(0.5 * number, float(x), float(y)) for number, (x, y) in enumerate(told[:, :2], start=1)
    )
