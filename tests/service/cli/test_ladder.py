"""From scenes to the table in one command."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from looktwice.model.bundled import SCENES
from looktwice.service.cli import ladder, serving
from looktwice.service.cli.commands import app


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The commands that it would run; each leaves behind what it would make."""
    ran: list[list[str]] = []

    def run(*parts: list[str]) -> None:
        command = [word for part in parts for word in part]
        ran.append(command)
        if "--to" in command:
            made = Path(command[command.index("--to") + 1])
            if made.suffix == ".parquet":
                made.touch()
            else:
                made.mkdir()
                (made / "looktwice.json").touch()

    monkeypatch.setattr(ladder, "_run", run)
    monkeypatch.setattr(serving, "_wait_for", lambda *_: None)
    monkeypatch.setattr("looktwice.service.cli.serving.subprocess.Popen", _NoProcess)
    return ran


class _NoProcess:
    def __init__(self, *_: object, **__: object) -> None:
        pass

    def terminate(self) -> None:
        pass

    def wait(self) -> None:
        pass


def climbed(folder: Path, *more: str) -> None:
    asked = ["train", "ladder", "--scenes", str(SCENES), "--test", str(SCENES), "--to", str(folder)]
    result = CliRunner().invoke(app, [*asked, "--learning-rate", "0.001", "--steps", "2", *more])
    assert result.exit_code == 0, result.output


def trained(commands: list[list[str]]) -> list[tuple[str, str, str]]:
    """Recipe, source and target of each training."""
    return [
        (
            command[command.index("train") + 1],
            Path(command[command.index("--from") + 1]).name,
            Path(command[command.index("--to") + 1]).name,
        )
        for command in commands
        if "train" in command and "--from" in command
    ]


LADDER = [
    ("counterfactual", "meta-act", "counterfactual"),
    ("multi-round", "meta-act", "multi-round"),
    ("counterfactual", "meta-act", "whole-dataset"),
    ("counterfactual", "counterfactual", "round-2"),
]


def test_it_begins_with_nothing_but_scenes(commands: list[list[str]], tmp_path: Path) -> None:
    climbed(tmp_path / "ladder")
    assert trained(commands) == [
        ("read-tracks", "untrained", "tracks"),
        ("language", "tracks", "language"),
        ("ground", "untrained", "ground"),
        ("read-scene", "language", "scene"),
        ("meta-act", "scene", "meta-act"),
        *LADDER,
    ]
    of_rung = {command[command.index("train") + 1]: command for command in commands if "train" in command}
    assert of_rung["read-scene"][of_rung["read-scene"].index("--vision-from") + 1].endswith("ladder/ground")
    assert "--learning-rate" not in of_rung["meta-act"]
    assert of_rung["counterfactual"][of_rung["counterfactual"].index("--learning-rate") + 1] == "0.001"
    assert all(command[command.index("--steps") + 1] == "2" for command in of_rung.values())
    assert commands[-1][3] == "evaluate"


def test_it_begins_with_a_checkpoint_and_goes_on_where_it_was(
    commands: list[list[str]], untrained_checkpoint: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "ladder"
    climbed(folder, "--from", str(untrained_checkpoint))
    assert trained(commands) == LADDER
    commands.clear()
    climbed(folder, "--from", str(untrained_checkpoint))
    assert [command[3] for command in commands] == ["evaluate"], "only the table is told again"


def test_the_papers_recipes_need_a_model_to_begin_with(commands: list[list[str]], tmp_path: Path) -> None:
    asked = [
        "train",
        "ladder",
        "--scenes",
        str(SCENES),
        "--test",
        str(SCENES),
        "--to",
        str(tmp_path / "ladder"),
    ]
    result = CliRunner().invoke(app, [*asked, "--paper"])
    assert result.exit_code == 2
    assert "--from" in result.output
    assert commands == []
