"""The file of dead letters: what could not be done, and why."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final, get_args

from looktwice.clients.labelling.ledger import Ledger, Stage
from looktwice.model.driving.whole_files import written_whole

FILE: Final = "dead_letters.jsonl"
_STAGES: Final[tuple[Stage, ...]] = get_args(Stage)


def write_dead_letters(ledger: Ledger, folder: Path) -> int:
    """Write all of a ledger's dead letters, one JSON object a line, and return how many there are."""
    count = 0
    with written_whole(folder / FILE) as temporary, temporary.open("w") as lines:
        for stage in _STAGES:
            for run in ledger.runs(stage):
                for entry in ledger.entries(run, "dead"):
                    letter = {"stage": stage, "run": run.id, "scene_id": entry.scene_id, "key": entry.key}
                    lines.write(json.dumps({**letter, "ended_at": entry.ended_at, **entry.record}) + "\n")
                    count += 1
    return count
