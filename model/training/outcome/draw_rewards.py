"""What a draw is worth in a labelled scene: what comes of it, and whether its parts agree.

Rewards are pure functions of a scene and its draws. What comes of a plan is NAVSIM's score against the true
ways of the others (`looktwice.model.driving.pdm`), with the expert as the reference of progress.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from looktwice.model.driving.agreement import agreement
from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.judging import SceneJudge
from looktwice.model.driving.pdm.labelled import plans_of
from looktwice.model.driving.pdm.scoring import COLLISIONS
from looktwice.model.driving.pdm.world import Array
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.engines.engine import Draw
from looktwice.model.families.family import Family, Reading

_FAR_M = 10.0
_GOAL_BOUNDS_M: Final = (2.0, 4.0, 6.0, 10.0, 15.0)
_GOAL_WORTH: Final = np.array([1.0, 0.8, 0.6, 0.4, 0.2, 0.0])
"""ELF-VLA, equation 10, which leaves distances of 0 and 15 m open: here they are worth 1 and 0."""


@dataclass(frozen=True)
class RewardWeights:
    """How much each part of a reward counts.

    Attributes:
        outcome: of NAVSIM's score, 0 to 1.
        imitation: of the mean distance to the expert, as a share of 10 m. It stays in against drivers who
            find a gap in the score, such as those who reverse at the end.
        words: lost where a draw's parts contradict each other.
        thinking: lost for a second look, which takes time.
        goal: of how near to the expert's the last pose is, 0 to 1 (ELF-VLA, equation 10).
        form: of thoughts that are there and a trajectory that is whole, a half each (ELF-VLA section 8.1).
            What a cursor writes always has both.
    """

    outcome: float = 1.0
    imitation: float = 0.5
    words: float = 0.1
    thinking: float = 0.02
    goal: float = 0.0
    form: float = 0.0


class Rewards(NamedTuple):
    """What `rewards` and `family_rewards` give.

    Attributes:
        total: float32 [draws].
        outcome: float32 [draws], NAVSIM's scores alone; the total where they are not asked.
        parts: means over the draws, for a log.
    """

    total: FloatArray
    outcome: FloatArray
    parts: Mapping[str, float]


def rewards(
    judge: SceneJudge,
    draws: Sequence[Draw],
    weights: RewardWeights = RewardWeights(),
    version: Version = "v2.2",
) -> Rewards:
    """What draws of one scene are worth.

    Args:
        judge: of the scene.
        draws: its responses, at least one, with trajectories at 10 Hz up to 6.4 s or at 0.5 s up to 4 s.
        weights: of the parts.
        version: whose rules score them.

    Raises:
        ScoreError: the scene's agents are not known for as long as the score looks ahead.
    """
    labelled = judge.labelled
    trajectories = np.stack([draw.at_10_hz for draw in draws])
    scores = judge.scores(plans_of(np.stack([draw.scored for draw in draws])), version)
    outcome = np.nan_to_num(scores.partial_score)
    apart_m = trajectories[..., :2] - labelled.future[: trajectories.shape[1], :2]
    away_m = np.linalg.norm(apart_m, axis=-1).mean(axis=-1)
    goal = goal_reward(np.abs(apart_m[:, -1]).sum(axis=-1))
    contradict = np.array([_contradicts(labelled, draw) for draw in draws], np.float64)
    thinks = np.array([draw.looked_twice for draw in draws], np.float64)
    form = np.array([form_reward(draw) for draw in draws])
    total = (
        weights.outcome * outcome
        - weights.imitation * np.minimum(away_m, _FAR_M) / _FAR_M
        - weights.words * contradict
        - weights.thinking * thinks
        + weights.goal * goal
        + weights.form * form
    )
    collisions = scores.sub_scores[COLLISIONS]
    parts = {
        "outcome": float(outcome.mean()),
        "ade_m": float(away_m.mean()),
        "collision_rate": 0.0 if collisions is None else float((collisions < 1).mean()),
        "contradiction_rate": float(contradict.mean()),
        "think_rate": float(thinks.mean()),
        "goal": float(goal.mean()),
        "form": float(form.mean()),
    }
    return Rewards(total.astype(np.float32), outcome.astype(np.float32), parts)


def family_rewards(
    family: Family, future: FloatArray, draws: Sequence[Draw], weights: Mapping[str, float]
) -> Rewards:
    """What draws of one scene are worth by their family's own rewards.

    Args:
        family: that has such rewards.
        future: float32 [64, 4], the expert's trajectory at 10 Hz.
        draws: responses to the scene, at least one.
        weights: of the rewards by name; all of the family's.

    Raises:
        ValueError: the family has no rewards, or others than those that are weighed.
    """
    if family.rewards is None:
        raise ValueError(f"{family.name} has no rewards of its own")
    judged = [
        family.rewards(future, Reading(draw.trajectory, foreseen=draw.foreseen, action=draw.action))
        for draw in draws
    ]
    if judged[0].keys() != weights.keys():
        raise ValueError(f"rewards are {', '.join(judged[0])}, and {', '.join(weights)} are weighed")
    parts = {name: np.array([each[name] for each in judged]) for name in weights}
    total = sum(weights[name] * worth for name, worth in parts.items())
    found = np.asarray(total, np.float32)
    return Rewards(found, found, {name: float(worth.mean()) for name, worth in parts.items()})


def goal_reward(away_m: FloatArray) -> Array:
    """Worth [n] of last poses that are so far from the expert's, in metres along x and y added up."""
    worth: Array = _GOAL_WORTH[np.searchsorted(_GOAL_BOUNDS_M, away_m, side="right")]
    return worth


def form_reward(draw: Draw) -> float:
    """A half for thoughts, a half for a trajectory with all its poses."""
    whole = draw.trajectory.shape == (len(draw.times_s), 4) and bool(np.isfinite(draw.trajectory).all())
    return 0.5 * bool(draw.thinking) + 0.5 * whole


def _contradicts(labelled: LabelledScene, draw: Draw) -> bool:
    judged = agreement(draw.plan, draw.thinking, draw.revised_plan, draw.trajectory, labelled.scene.history)
    return judged.consistent is False
