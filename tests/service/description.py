"""Prints the API's description, with keys asked for, so that everything it can declare is in it."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from looktwice.service.app import create_app
from looktwice.service.operations.keys import new_line
from looktwice.service.operations.settings import Settings
from tests.service.scripted_engine import ScriptedEngine


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        keys = Path(folder) / "keys"
        keys.write_text(new_line("somebody")[1])
        print(json.dumps(create_app(ScriptedEngine(), Settings(api_keys_file=keys)).openapi()))


if __name__ == "__main__":
    main()
