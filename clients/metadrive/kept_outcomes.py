"""Outcomes that are known already, so that a run that was cut goes on behind them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from clients.metadrive.outcomes import MomentOutcomes
from clients.metadrive.replay import EpisodeSetting
from clients.metadrive.workers import Asked
from model.driving.hashing import hash_of
from model.driving.outcome import OUTCOMES_VERSION, Outcome


class KeptOutcomes:
    """Outcomes in a file, one JSON object a line; what a kill left of a line is forgotten.

    Args:
        file: made if it is not there; None keeps them in memory alone.
    """

    def __init__(self, file: Path | None) -> None:
        self._file = file
        text = file.read_text() if file is not None and file.exists() else ""
        whole, _, torn = text.rpartition("\n")
        if torn and file is not None:
            file.write_text(f"{whole}\n" if whole else "")
        lines = [json.loads(line) for line in whole.splitlines()]
        self._kept = {line["key"]: _outcomes(line["outcomes"]) for line in lines}

    def find(self, key: str) -> MomentOutcomes | None:
        """What was kept under a key."""
        return self._kept.get(key)

    def keep(self, key: str, found: MomentOutcomes) -> None:
        """Keep outcomes; they are in the file when this returns."""
        self._kept[key] = found
        if self._file is None:
            return
        told = [outcome.to_json() for outcome in (found.expert, *found.plans)]
        with self._file.open("a") as file:
            file.write(json.dumps({"key": key, "outcomes": told}) + "\n")


def key_of(asked: Asked, setting: EpisodeSetting) -> str:
    """What the outcomes of some trajectories at a moment are found by."""
    moment, trajectories = asked
    told = [moment.scene_id, OUTCOMES_VERSION, asdict(setting)]
    arrays = (moment.history, moment.future, *trajectories)
    return hash_of(told, *(array.astype("<f4").tobytes() for array in arrays))


def _outcomes(told: Sequence[dict[str, object]]) -> MomentOutcomes:
    expert, *plans = (Outcome.from_json(each) for each in told)
    return MomentOutcomes(expert, tuple(plans))
