"""Results that are known already, so that a run that was cut goes on behind them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Generic, TypeVar

from looktwice.clients.metadrive.drive import Drive
from looktwice.clients.metadrive.outcomes import MomentOutcomes
from looktwice.clients.metadrive.replay import EpisodeSetting
from looktwice.clients.metadrive.workers import FollowTask
from looktwice.model.driving.hashing import hash_of
from looktwice.model.driving.outcome import OUTCOMES_VERSION, Outcome

_Result = TypeVar("_Result")


class ResultStore(Generic[_Result]):
    """Results in a file, one JSON object a line; what a kill left of a line is forgotten.

    Args:
        file: made if it is not there; None keeps them in memory alone.
        field: of a line that holds the result, beside ``key``.
        to_json, from_json: of one result.
    """

    def __init__(
        self,
        file: Path | None,
        field: str,
        to_json: Callable[[_Result], Any],
        from_json: Callable[[Any], _Result],
    ) -> None:
        self._file, self._field, self._to_json = file, field, to_json
        text = file.read_text() if file is not None and file.exists() else ""
        whole, _, torn = text.rpartition("\n")
        if torn and file is not None:
            file.write_text(f"{whole}\n" if whole else "")
        lines = [json.loads(line) for line in whole.splitlines()]
        self._results = {line["key"]: from_json(line[field]) for line in lines}

    def find(self, key: str) -> _Result | None:
        """The result that is stored under a key."""
        return self._results.get(key)

    def store(self, key: str, result: _Result) -> None:
        """Store a result; it is in the file when this returns."""
        self._results[key] = result
        if self._file is not None:
            with self._file.open("a") as file:
                file.write(json.dumps({"key": key, self._field: self._to_json(result)}) + "\n")


def drive_store(file: Path) -> ResultStore[Drive]:
    """Drives of whole episodes."""
    return ResultStore(file, "drive", asdict, lambda told: Drive(**told))


def outcome_store(file: Path | None) -> ResultStore[MomentOutcomes]:
    """Outcomes of trajectories, by `outcome_key`."""

    def to_json(found: MomentOutcomes) -> list[dict[str, Any]]:
        return [outcome.to_json() for outcome in (found.expert, *found.plans)]

    def from_json(told: list[dict[str, Any]]) -> MomentOutcomes:
        expert, *plans = (Outcome.from_json(each) for each in told)
        return MomentOutcomes(expert, tuple(plans))

    return ResultStore(file, "outcomes", to_json, from_json)


def outcome_key(task: FollowTask, setting: EpisodeSetting) -> str:
    """What the outcomes of some trajectories at a moment are found by."""
    moment, trajectories = task
    told = [moment.scene_id, OUTCOMES_VERSION, asdict(setting)]
    arrays = (moment.history, moment.future, *trajectories)
    return hash_of(told, *(array.astype("<f4").tobytes() for array in arrays))
