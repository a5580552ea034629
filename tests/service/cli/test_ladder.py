"""From scenes to the table: which commands are left to be run, and a round of them run."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import typer
from typer.testing import CliRunner

from looktwice.model.bundled import SCENES
from looktwice.model.driving.reflection_store import read_reflections
from looktwice.model.driving.scene_store import read_scenes, write_scenes
from looktwice.model.evaluation.ladder import COUNTERFACTUAL, META_ACT, MULTI_ROUND, ROUND_2, WHOLE_DATASET
from looktwice.model.network.checkpoint import load
from looktwice.service.cli.commands import app
from looktwice.service.cli.ladder import Step, follow, steps_left

TRAINING = ("--learning-rate", "0.001", "--steps", "2")
LADDER = [
    ("counterfactual", "meta-act", "counterfactual"),
    ("multi-round", "meta-act", "multi-round"),
    ("counterfactual", "meta-act", "whole-dataset"),
    ("counterfactual", "counterfactual", "round-2"),
]


def left(folder: Path) -> list[Step]:
    """What is left in a ladder's folder; every command is one that `looktwice` has, with these options."""
    steps = steps_left(folder, SCENES, SCENES, TRAINING, every=6, processes=1)
    for step in steps:
        words = [*step.words, *(("--service", "http://localhost") if step.served else ())]
        command: Any = typer.main.get_command(app)
        while hasattr(command, "commands"):
            command = command.commands[words.pop(0)]
        command.make_context("looktwice", words)
    return steps


def value(step: Step, option: str) -> str:
    return step.words[step.words.index(option) + 1]


def trained(steps: Sequence[Step]) -> list[tuple[str, str, str]]:
    """Recipe, source and target of each training."""
    return [
        (step.words[1], Path(value(step, "--from")).name, Path(value(step, "--to")).name)
        for step in steps
        if step.words[0] == "train" and step.words[1] != "create"
    ]


def linked(folder: Path, checkpoint: Path, *names: str) -> None:
    for name in names:
        (folder / name).symlink_to(checkpoint, target_is_directory=True)


def test_it_begins_with_nothing_but_scenes(tmp_path: Path) -> None:
    steps = left(tmp_path)
    assert trained(steps) == [
        ("read-tracks", "untrained", "tracks"),
        ("language", "tracks", "language"),
        ("ground", "untrained", "ground"),
        ("read-scene", "language", "scene"),
        ("meta-act", "scene", "meta-act"),
        *LADDER,
    ]
    recipes = {step.words[1]: step for step in steps if step.words[0] == "train"}
    assert steps[0] is recipes["create"]
    assert value(recipes["read-scene"], "--vision-from") == str(tmp_path / "ground")
    assert "--learning-rate" not in recipes["meta-act"].words
    assert value(recipes["counterfactual"], "--learning-rate") == "0.001"
    assert all(value(step, "--steps") == "2" for step in recipes.values())
    # What is learned from is made right before it is learned, of plans of the entry that it is named for.
    made: list[str] = []
    for step in steps:
        if step.words[1] == "export":
            made.append(value(step, "--to"))
        elif "--reflections" in step.words:
            assert value(step, "--reflections") in made
    assert [Path(file).stem for file in made] == ["round-1", "whole", "round-2"]
    served = [step.served.name for step in steps if step.served is not None]
    assert served == [META_ACT, META_ACT, COUNTERFACTUAL]
    assert steps[-1].words[0] == "evaluate"


def test_it_goes_on_where_it_was(untrained_checkpoint: Path, tmp_path: Path) -> None:
    linked(tmp_path, untrained_checkpoint, META_ACT)
    assert trained(left(tmp_path)) == LADDER
    (tmp_path / "round-1.parquet").touch()
    steps = left(tmp_path)
    assert trained(steps) == LADDER
    assert [Path(value(step, "--to")).stem for step in steps if step.words[1] == "export"] == [
        "whole",
        "round-2",
    ]
    linked(tmp_path, untrained_checkpoint, COUNTERFACTUAL, MULTI_ROUND, WHOLE_DATASET, ROUND_2)
    assert [step.words[0] for step in left(tmp_path)] == ["evaluate"], "only the table is told again"


def test_a_data_set_is_made_and_learned(brief_checkpoint: Path, tmp_path: Path) -> None:
    """Behind a real service. The table, which comes last, is a test of `evaluate --preset ladder`."""
    linked(tmp_path, brief_checkpoint, META_ACT, COUNTERFACTUAL, MULTI_ROUND, ROUND_2)
    scenes = tmp_path / "scenes.parquet"
    write_scenes(scenes, islice(read_scenes(SCENES), 3))

    def here(command: Sequence[str]) -> int:
        """In this process, which has imported everything."""
        words = command[command.index("looktwice.service.cli") + 1 :]
        return CliRunner().invoke(app, words, catch_exceptions=False).exit_code

    training = ("--steps", "2", "--batch-size", "2", "--cache", str(tmp_path / "cache"))
    *steps, table = steps_left(tmp_path, scenes, scenes, training, every=1, processes=1)
    assert table.words[0] == "evaluate"
    for step in steps:
        follow(step, here)
    learned = load(tmp_path / WHOLE_DATASET).card.details["stages"][-1]
    assert learned["name"] == "counterfactual"
    assert learned["reflections_count"] == len(list(read_reflections(tmp_path / "whole.parquet"))) > 0


def test_a_step_that_fails_ends_it_and_is_named(tmp_path: Path) -> None:
    nowhere, folder = str(tmp_path / "nowhere"), str(tmp_path / "ladder")
    asked = ["train", "ladder", "--scenes", nowhere, "--test", nowhere, "--to", folder, "--steps", "2"]
    result = CliRunner().invoke(app, asked)
    assert result.exit_code == 2
    command = f"train create --to {folder}/untrained --scenes {nowhere} --steps 2"
    assert f"{command}\n" in result.output, "it is told before it is run"
    assert f"{command} ended with code 2" in result.output


def test_the_papers_recipes_need_a_model_to_begin_with(tmp_path: Path) -> None:
    asked = ["train", "ladder", "--scenes", str(SCENES), "--test", str(SCENES), "--paper"]
    result = CliRunner().invoke(app, [*asked, "--to", str(tmp_path / "ladder")])
    assert result.exit_code == 2
    assert "--from" in result.output
    assert not (tmp_path / "ladder").exists()
