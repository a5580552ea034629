"""The examples of the documentation, run as users run them against a real service."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from clients.metadrive import simulator
from service.settings import Settings
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, serve

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with serve(ScriptedEngine(), Settings()) as made:
        yield made


def run(name: str, *arguments: str) -> str:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_plan_in_ten_lines(served: Served) -> None:
    printed = run("plan_in_ten_lines.py", served.url)
    assert printed.count("think probability") == 6
    assert printed.rstrip().splitlines()[-1].startswith("  - ")
    lines = (EXAMPLES / "plan_in_ten_lines.py").read_text().split('"""')[2].splitlines()
    # What needs saying besides imports and blank lines.
    assert len([line for line in lines if line and not line.startswith(("import", "from"))]) <= 10


def test_reflect_on_another_plan(served: Served) -> None:
    printed = run("reflect_on_another_plan.py", served.url)
    assert printed.count("think probability") == 12
    assert "Accelerate -> " in printed


@pytest.mark.skipif(not simulator.is_installed(), reason="MetaDrive is not installed (make sim)")
def test_drive_metadrive(served: Served, tmp_path: Path) -> None:
    film = tmp_path / "drive.gif"
    printed = run("drive_metadrive.py", "--service", served.url, "--film", str(film), "--seconds", "4")
    assert f"see {film}" in printed
    with Image.open(film) as shown:
        assert getattr(shown, "n_frames", 1) > 3
