"""Exports that are killed at the worst moment: all is written, and nothing in its place yet."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from looktwice.clients.labelling.ledger import Ledger
from looktwice.clients.labelling.teachers.teacher import Answer
from tests.clients.labelling.builds import GOOD, rolled_out, scenes
from tests.clients.labelling.test_label import Scripted, labelled

SCENES = 3
KILLED = """
import os, signal, sys
from looktwice.service.cli.commands import app

def at_the_first_rename(event, args):
    if event == "os.rename":
        os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(at_the_first_rename)
app()
"""
# Python renames what it compiles, too.
_ENVIRONMENT = {
    "LOOKTWICE_TEACHER_KIND": "openai",
    "LOOKTWICE_TEACHER_MODEL": "batched",
    "PYTHONDONTWRITEBYTECODE": "1",
}


@pytest.mark.parametrize(
    ("form", "results"),
    [
        ("parquet", {"out"}),
        ("openai-batch", {"out"}),
        ("messages", {"messages.jsonl", "trl.jsonl", "dataset_info.json"}),
    ],
)
def test_a_killed_export_is_no_result_and_leaves_nothing_to_the_next(
    form: str, results: set[str], tmp_path: Path
) -> None:
    build, file = tmp_path / "build", scenes(tmp_path, SCENES)
    rolled_out(build, SCENES)
    with Ledger(build) as ledger:
        labelled(ledger, file, Scripted(Answer(GOOD)))
    folder = tmp_path / "exported"
    folder.mkdir()
    to = folder if form == "messages" else folder / "out"
    options = ["build", "export", str(build), "--form", form, "--scenes", str(file), "--to", str(to)]

    def export(*python: str) -> int:
        environment = os.environ | _ENVIRONMENT
        return subprocess.run([sys.executable, *python, *options], env=environment, check=False).returncode

    assert export("-c", KILLED) == -signal.SIGKILL
    left = files(folder)
    assert left, "it had written"
    assert not results & left, "what was not finished must not look so"
    assert export("-m", "looktwice.service.cli") == 0
    assert files(folder) == results


def files(folder: Path) -> set[str]:
    """Names of files; a data set's pictures are in a folder of their own."""
    return {file.name for file in folder.iterdir() if file.is_file()}
