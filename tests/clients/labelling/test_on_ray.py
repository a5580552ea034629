"""Rollout and labelling on a local Ray, against a real service.

In processes of their own: Ray keeps threads that change this process's warning filters under other tests.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from looktwice.clients.labelling.ledger import Ledger
from looktwice.model.driving.scene_store import write_scenes
from looktwice.service.operations.settings import Settings
from tests.clients.labelling.builds import named, without_future
from tests.service.scenes import labelled
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve

FILES, EACH = 3, 4


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, one = tmp_path_factory.mktemp("scenes"), labelled("scene")
    for file in range(FILES):
        found = [named(one, f"scene-{file}-{number}") for number in range(EACH)]
        write_scenes(folder / f"{file}.parquet", found)
    without_future(folder / "0.parquet", "scene-0-1")
    return folder


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    settings = Settings(bundled_scenes=tmp_path_factory.mktemp("none") / "none")
    with serve(ScriptedEngine(), settings) as served:
        yield served.url


def build(*arguments: object) -> dict[str, Any]:
    command = [
        sys.executable,
        "-m",
        "looktwice.service.cli",
        "build",
        *map(str, arguments),
        "--ray",
        "local",
        "--json",
    ]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert ended.returncode == 0, ended.stderr
    told: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
    return told


def test_rolled_out_and_labelled_by_workers(scenes: Path, url: str, tmp_path: Path) -> None:
    first = build("rollout", tmp_path, scenes, "--service", url, "--n", 2)
    assert (first["done"], first["dead"], first["earlier"]) == (FILES * EACH - 1, 0, 0)
    assert first["left_out"] == 1
    again = build("rollout", tmp_path, scenes, "--service", url, "--n", 2)
    assert (again["done"], again["earlier"]) == (0, FILES * EACH - 1)

    with Ledger(tmp_path) as ledger:
        run = ledger.the_run("rollout")
        keys = [entry.key for entry in ledger.entries(run)][: EACH + 1]
        ledger.select(run, [(key, (0, 1)) for key in keys])
    done = build("label", tmp_path, scenes)
    assert (done["done"], done["dead"], done["answers"]) == (EACH + 1, 0, EACH + 1)
    with Ledger(tmp_path) as ledger:
        labels = ledger.the_run("label")
        assert {entry.record["rollout"] for entry in ledger.entries(labels)} == set(keys)

    asked = build("label", tmp_path, scenes, "--teacher", "service", "--service", url, "--seed", 1)
    assert (asked["done"], asked["dead"], asked["answers"]) == (EACH + 1, 0, EACH + 1)
