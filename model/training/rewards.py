"""What a draw is worth in a labelled scene: what comes of it, and whether its parts agree.

Rewards are pure functions of a scene and its draws. What comes of a plan is NAVSIM's score against the true
ways of the others (`model.driving.pdm`), with the expert as the reference of progress.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from model.driving.agreement import agreement
from model.driving.pdm.labelled import plans_of, world_of
from model.driving.pdm.scoring import COLLISIONS, Others, score
from model.driving.scene import LabelledScene
from model.driving.trajectory import FloatArray
from model.engines.engine import Draw

_FAR_M = 10.0


@dataclass(frozen=True)
class RewardWeights:
    """How much each part of a reward counts.

    Attributes:
        outcome: of NAVSIM's score, 0 to 1.
        imitation: of the mean distance to the expert, as a share of 10 m. It stays in against drivers who
            find a gap in the score, such as those who reverse at the end.
        words: lost where a draw's parts contradict each other.
        thinking: lost for a second look, which takes time.
    """

    outcome: float = 1.0
    imitation: float = 0.5
    words: float = 0.1
    thinking: float = 0.02


def rewards(
    labelled: LabelledScene, draws: Sequence[Draw], weights: RewardWeights = RewardWeights()
) -> tuple[FloatArray, Mapping[str, float]]:
    """Rewards float32 [draws], and the means of their parts for a log.

    Args:
        labelled: the scene with what really came.
        draws: its responses, with trajectories at 10 Hz up to 6.4 s.
        weights: of the parts.

    Raises:
        ScoreError: the scene's agents are not known for as long as the score looks ahead.
    """
    trajectories = np.stack([draw.at_10_hz for draw in draws])
    expert = plans_of(labelled.future[None])[0]
    scores = score(world_of(labelled), plans_of(trajectories), others=Others(expert, "expert"), centre=True)
    outcome = np.nan_to_num(scores.partial_score)
    away_m = np.linalg.norm(trajectories[..., :2] - labelled.future[:, :2], axis=-1).mean(axis=-1)
    contradict = np.array([_contradicts(labelled, draw) for draw in draws], np.float64)
    thinks = np.array([draw.looked_twice for draw in draws], np.float64)
    total = (
        weights.outcome * outcome
        - weights.imitation * np.minimum(away_m, _FAR_M) / _FAR_M
        - weights.words * contradict
        - weights.thinking * thinks
    )
    collisions = scores.sub_scores[COLLISIONS]
    parts = {
        "outcome": float(outcome.mean()),
        "ade_m": float(away_m.mean()),
        "collision_rate": 0.0 if collisions is None else float((collisions < 1).mean()),
        "contradiction_rate": float(contradict.mean()),
        "think_rate": float(thinks.mean()),
    }
    return total.astype(np.float32), parts


def _contradicts(labelled: LabelledScene, draw: Draw) -> bool:
    judged = agreement(draw.plan, draw.thinking, draw.revised_plan, draw.trajectory, labelled.scene.history)
    return judged.consistent is False
