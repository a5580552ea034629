"""docs/add-a-family.md to the letter: the package that it makes is installed, trained and planned with."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

from looktwice.model.bundled import SCENES
from looktwice.model.families.registry import GROUP

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "add-a-family.md").read_text()
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", PAGE, re.S)
MODULE = "\n\n".join(code for kind, code in BLOCKS[:4])
COMMANDS = [line.split() for _, code in BLOCKS[5:] for line in code.splitlines()]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what ``pip install`` leaves of the package; commands run in it."""
    folder = tmp_path_factory.mktemp("installed")
    package = folder / "my_package"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "toy.py").write_text(MODULE)
    project = tomllib.loads(BLOCKS[4][1])["project"]
    about = folder / f"my_package-{project['version']}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    declared = "\n".join(f"{name} = {where}" for name, where in project["entry-points"][GROUP].items())
    (about / "entry_points.txt").write_text(f"[{GROUP}]\n{declared}\n")
    for name in ("train", "validation"):
        (folder / "data" / name).mkdir(parents=True)
        (folder / "data" / name / SCENES.name).symlink_to(SCENES)
    return folder


def run(folder: Path, *command: str) -> str:
    environment: Mapping[str, str] = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_its_package_is_trained_and_planned_with(installed: Path) -> None:
    assert [kind for kind, _ in BLOCKS] == ["python"] * 4 + ["toml", "bash", "bash"]
    train, plan, evaluate = COMMANDS
    assert train[-2:] == ["--steps", "2000"]
    looktwice = str(Path(sys.executable).with_name("looktwice"))
    run(installed, looktwice, *train[1:-1], "2", "--batch-size", "2")
    planned = run(installed, looktwice, *plan[1:])
    assert "in 4 s at" in planned
    table = run(installed, looktwice, *evaluate[1:])
    assert "toy" in table
