"""The examples of the documentation, run as users run them against a real service."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import AsyncGenerator, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from looktwice.clients.metadrive import simulator
from looktwice.model.bundled import SCENES
from looktwice.model.driving.images import decode_image
from looktwice.model.driving.next_view import Motion
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.engine import DrawFinished, Event, PlanRequest
from looktwice.service.operations.settings import Settings
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN, ScriptedEngine
from tests.service.serving import Served, serve

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with serve(ScriptedEngine(), Settings()) as made:
        yield made


def run(name: str, *arguments: str) -> str:
    return finished([str(EXAMPLES / name), *arguments])


def finished(arguments: list[str], folder: Path | None = None) -> str:
    """What a Python command prints, warnings too."""
    done = subprocess.run(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        cwd=folder,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def test_plan_in_ten_lines(served: Served) -> None:
    printed = run("plan_in_ten_lines.py", served.url)
    assert printed.count("think probability") == 6
    lines = (EXAMPLES / "plan_in_ten_lines.py").read_text().split('"""')[2].splitlines()
    # What needs saying besides imports and blank lines.
    assert len([line for line in lines if line and not line.startswith(("import", "from"))]) <= 10


class LastSlowsDown(ScriptedEngine):
    """The last draw's plan is another one than that of the others."""

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        async for event in super().submit(request):
            if isinstance(event, DrawFinished) and event.draw.index == request.controls.n - 1:
                event = DrawFinished(replace(event.draw, plan=SLOW_DOWN))
            yield event


def test_the_plan_that_is_shown_is_the_one_to_drive_by() -> None:
    with serve(LastSlowsDown(), Settings()) as made:
        printed = run("plan_in_ten_lines.py", made.url)
    assert printed.endswith(f"Draw 0 lies nearest to the others:\n{KEEP_ON}\n")


def test_reflect_on_another_plan(served: Served) -> None:
    printed = run("reflect_on_another_plan.py", served.url)
    assert printed.count("think probability") == 12
    assert "Accelerate -> " in printed


def test_imagine(tmp_path: Path) -> None:
    engine = ScriptedEngine()
    engine.card_shown = replace(engine.card, formats=("cf_vla", "vla_world"), paints=True)
    with serve(engine, Settings()) as made:
        printed = run("imagine.py", made.url, str(tmp_path / "seen"))
    told = re.findall(r"seen/([a-z-]+)\.png: in half a second at ", printed)
    assert told == ["as-it-expects", "as-planned", "straight-on", "if-it-stood-still"]
    for name in told:
        assert decode_image((tmp_path / "seen" / f"{name}.png").read_bytes()).shape == (112, 224, 3)
    _, free, planned, straight_on, still = (request.controls.motion for request in engine.submitted)
    assert free is None
    assert still == Motion(0.0, 0.0, 0.0)
    assert planned is not None
    assert straight_on is not None
    assert planned.x_m > 0
    assert straight_on.y_m == 0


def test_the_drive_is_imported_by_the_figures_of_its_own_camera(tmp_path: Path) -> None:
    run("drive_folder.py", str(tmp_path / "drive"))
    page = (ROOT / "docs" / "own-cameras.md").read_text()
    (command,) = re.findall(r"^looktwice (scenes import drive .*\\\n.*)$", page, re.MULTILINE)
    told = finished(["-m", "looktwice.service.cli", *shlex.split(command.replace("\\\n", " "))], tmp_path)
    assert "grey" not in told
    given, imported = (
        decode_image(next(read_scenes(path, dense=False)).scene.clips[0].images[-1]).astype(float)
        for path in (SCENES, tmp_path / "scenes.parquet")
    )
    assert np.abs(given - imported).mean() < 8, "as the model's own camera takes it"


def test_aiperf_inputs(served: Served, tmp_path: Path) -> None:
    printed = run("aiperf_inputs.py", str(tmp_path / "inputs.json"), "3")
    assert printed.endswith(": 3 requests\n")
    sessions = json.loads((tmp_path / "inputs.json").read_text())["data"]
    assert len({session["session_id"] for session in sessions}) == 3
    for session in sessions:
        (asked,) = session["payloads"]
        answer = served.http.post("/v1/plan", json=asked)
        assert answer.status_code == 200, answer.text
        assert answer.json()["request_id"]  # what aiperf is told to look for


@pytest.mark.skipif(not simulator.is_installed(), reason="MetaDrive is not installed (make sim)")
def test_drive_metadrive(served: Served, tmp_path: Path) -> None:
    film = tmp_path / "drive.gif"
    printed = run("drive_metadrive.py", "--service", served.url, "--film", str(film), "--seconds", "4")
    assert f"see {film}" in printed
    with Image.open(film) as shown:
        assert getattr(shown, "n_frames", 1) > 3
