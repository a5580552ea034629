"""Episodes that were driven already, so that a run that was cut goes on behind them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from clients.metadrive.drive import Drive


class KeptDrives:
    """Drives in a file, one JSON object a line; what a kill left of a line is forgotten.

    Args:
        file: made if it is not there.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        text = file.read_text() if file.exists() else ""
        whole, _, torn = text.rpartition("\n")
        if torn:
            file.write_text(f"{whole}\n" if whole else "")
        lines = [json.loads(line) for line in whole.splitlines()]
        self._kept = {line["key"]: Drive(**line["drive"]) for line in lines}

    def find(self, key: str) -> Drive | None:
        """The drive that was kept under a key."""
        return self._kept.get(key)

    def keep(self, key: str, drive: Drive) -> None:
        """Keep a drive; it is in the file when this returns."""
        self._kept[key] = drive
        with self._file.open("a") as file:
            file.write(json.dumps({"key": key, "drive": asdict(drive)}) + "\n")
