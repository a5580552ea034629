"""What the README shows runs as it stands, against a service at another port."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from model.bundled import CHECKPOINT
from model.engines.torch.engine import TorchEngine, TorchSettings
from service.settings import Settings
from tests.service.serving import serve

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", README, re.S)
PYTHON = [code for language, code in BLOCKS if language == "python"]
CURLS = [line for _, code in BLOCKS for line in code.splitlines() if line.startswith("curl ")]


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with serve(TorchEngine(CHECKPOINT, TorchSettings(rows=24)), Settings()) as served:
        yield served.url


@pytest.mark.parametrize("code", PYTHON)
def test_its_python_runs(code: str, url: str) -> None:
    told = subprocess.run(
        [sys.executable, "-c", code.replace("http://localhost:8000", url)],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
    )
    assert told.returncode == 0, told.stderr
    assert "done" in told.stdout


@pytest.mark.parametrize("line", CURLS)
def test_its_requests_are_answered(line: str, url: str) -> None:
    command = line.replace("curl -s", "curl -s --fail-with-body").replace("localhost:8000", url)
    told = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=120, check=False, cwd=ROOT
    )
    assert told.returncode == 0, told.stdout + told.stderr
    assert '"draws"' in told.stdout


def test_there_is_something_to_run() -> None:
    assert PYTHON
    assert len(CURLS) >= 2
