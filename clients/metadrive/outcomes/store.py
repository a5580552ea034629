"""Outcomes that are known already, and those that are not: what was followed once is not followed again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

from looktwice.clients.metadrive.outcomes.replayed_worlds import EpisodeSetting, FollowTask
from looktwice.clients.metadrive.outcomes.verdicts import MomentOutcomes
from looktwice.clients.metadrive.outcomes.workers import follow_episodes
from looktwice.clients.metadrive.result_store import ResultStore
from looktwice.model.driving.hashing import hash_of
from looktwice.model.driving.outcome import OUTCOMES_VERSION, Outcome


def outcome_store(file: Path | None) -> ResultStore[MomentOutcomes]:
    """Outcomes of trajectories, by `outcome_key`; what was tried instead of them is not kept."""

    def to_json(found: MomentOutcomes) -> list[dict[str, Any]]:
        return [outcome.to_json() for outcome in (found.expert, *found.plans)]

    def from_json(told: list[dict[str, Any]]) -> MomentOutcomes:
        expert, *plans = (Outcome.from_json(each) for each in told)
        return MomentOutcomes(expert, tuple(plans), (None,) * len(plans))

    return ResultStore(file, "outcomes", to_json, from_json)


def outcome_key(task: FollowTask, setting: EpisodeSetting) -> str:
    """What the outcomes of some trajectories at a moment are found by."""
    moment, trajectories, _ = task
    told = [moment.scene_id, OUTCOMES_VERSION, asdict(setting)]
    arrays = (moment.history, moment.future, *trajectories)
    return hash_of(told, *(array.astype("<f4").tobytes() for array in arrays))


def follow_unknown(
    asked: Iterable[FollowTask],
    setting: EpisodeSetting,
    workers: int,
    store: ResultStore[MomentOutcomes],
) -> Iterator[tuple[str, MomentOutcomes | str]]:
    """What comes of trajectories, of those that are known first; new outcomes are stored.

    Args:
        asked: one of each scene.
        setting: of their episodes.
        workers: processes.
        store: of what is known.

    Yields:
        Scene ids, each with how its trajectories fared or why that cannot be said.

    Raises:
        ReplayError: another one drove.
        WorkerDied: a process died.
    """
    keys: dict[str, str] = {}
    rest: list[FollowTask] = []
    for task in asked:
        key = outcome_key(task, setting)
        if (known := store.find(key)) is not None:
            yield task.moment.scene_id, known
        else:
            keys[task.moment.scene_id] = key
            rest.append(task)
    rest.sort(key=lambda task: task.moment.seed)
    episodes = (list(episode) for _, episode in groupby(rest, lambda task: task.moment.seed))
    for scene_id, outcomes in follow_episodes(episodes, setting, workers):
        if not isinstance(outcomes, str):
            store.store(keys[scene_id], outcomes)
        yield scene_id, outcomes
