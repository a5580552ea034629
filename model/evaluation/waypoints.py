"""Waypoints by the protocols of ST-P3 and UniAD, and actions by F1: the tables 1 and 3 of VLA-World."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from looktwice.model.driving.intervals import Interval, ratio_interval
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import TEN_HZ_S, FloatArray, at_times
from looktwice.model.evaluation.protocols import (
    WAYPOINT_TIMES_S,
    Array,
    BoolArray,
    Protocol,
    occupied_cells,
    st_p3,
    uniad,
)
from looktwice.model.families.family import Actions

PROTOCOLS: Final[tuple[Protocol, ...]] = ("ST-P3", "UniAD")


@dataclass(frozen=True)
class WaypointResult:
    """What one protocol tells of a scene's draws: means over the draws.

    Attributes:
        scene_id, episode_id: the scene's own.
        l2_1s_m, l2_2s_m, l2_3s_m, l2_m: distance to the expert, told at three times, and the mean of these.
        collision_1s, collision_2s, collision_3s, collision_rate: shares, likewise.
    """

    scene_id: str
    episode_id: str
    l2_1s_m: float
    l2_2s_m: float
    l2_3s_m: float
    l2_m: float
    collision_1s: float
    collision_2s: float
    collision_3s: float
    collision_rate: float


WAYPOINT_MEASURES: Final = tuple(WaypointResult.__annotations__)[2:]


class WaypointScene:
    """A labelled scene as the protocols see it; which cells are occupied is worked out once.

    Args:
        labelled: the scene.
    """

    def __init__(self, labelled: LabelledScene) -> None:
        self._labelled = labelled
        self._expert = waypoints_of(labelled.future, TEN_HZ_S)
        self._occupied: dict[Protocol, BoolArray] = {
            protocol: occupied_cells(protocol, labelled.agents) for protocol in PROTOCOLS
        }

    def measured(self, waypoints: Array) -> dict[Protocol, WaypointResult]:
        """What each protocol tells of draws with waypoints [n, 6, 2]."""
        draws = len(waypoints)
        experts = np.repeat(self._expert[None], draws, axis=0)
        results: dict[Protocol, WaypointResult] = {}
        for protocol, figures_of in zip(PROTOCOLS, (st_p3, uniad), strict=True):
            cells = self._occupied[protocol]
            figures = figures_of(waypoints, experts, np.broadcast_to(cells, (draws, *cells.shape)))
            results[protocol] = WaypointResult(
                *(self._labelled.scene.scene_id, self._labelled.episode_id),
                *(*figures.l2_m, figures.average_l2_m),
                *(*figures.collision_rate, figures.average_collision_rate),
            )
        return results


def waypoints_of(trajectory: FloatArray, times_s: Sequence[float]) -> Array:
    """The six waypoints [6, 2] of a trajectory [t, 4]; raises ValueError where it ends before 3 s."""
    if times_s[-1] < WAYPOINT_TIMES_S[-1]:
        raise ValueError(f"a trajectory of {times_s[-1]:g} s has no waypoint at {WAYPOINT_TIMES_S[-1]:g} s")
    return at_times(trajectory, times_s, WAYPOINT_TIMES_S)[:, :2].astype(np.float64)


@dataclass(frozen=True)
class ActionScore:
    """How well one word of actions is told from the others of its group, over all draws.

    Attributes:
        action: the word.
        true, said, both: draws whose expert does it, that say so, and of which both holds.
        f1: the harmonic mean of precision and recall; None where nobody does it and nobody says so.
        interval: 95 %, over episodes.
    """

    action: str
    true: int
    said: int
    both: int
    f1: float | None
    interval: Interval | None


def action_scores(
    actions: Actions,
    scenes: Sequence[LabelledScene],
    said: Mapping[str, Sequence[tuple[str, ...]]],
) -> list[ActionScore]:
    """The scores of all words, group by group.

    Args:
        actions: of the family.
        scenes: that were planned for.
        said: the actions of each scene's draws, by its id.
    """
    episodes = sorted({labelled.episode_id for labelled in scenes})
    place = {episode: index for index, episode in enumerate(episodes)}
    scores = []
    for group, words in enumerate(actions.groups):
        # How often each word is true, said, and both, in each episode.
        counts = np.zeros((len(words), 3, len(episodes)))
        for labelled in scenes:
            episode, true = place[labelled.episode_id], words.index(actions.of(labelled.future)[group])
            for action in said[labelled.scene.scene_id]:
                told = words.index(action[group])
                counts[true, 0, episode] += 1
                counts[told, 1, episode] += 1
                counts[true, 2, episode] += told == true
        scores += [_action_score(word, *of) for word, of in zip(words, counts, strict=True)]
    return scores


def _action_score(word: str, true: Array, said: Array, both: Array) -> ActionScore:
    totals = int(true.sum()), int(said.sum()), int(both.sum())
    either = true + said
    if not either.any():
        return ActionScore(word, *totals, None, None)
    f1 = 2 * float(both.sum() / either.sum())
    return ActionScore(word, *totals, f1, ratio_interval(2 * both, either))
