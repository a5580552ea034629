"""Outcomes that are known already."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from looktwice.clients.metadrive.outcomes.replayed_worlds import EpisodeSetting, FollowTask
from looktwice.clients.metadrive.outcomes.verdicts import MomentOutcomes
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
