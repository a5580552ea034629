"""From scenes to the table: which commands are left to be run, and a round of them run."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from looktwice.clients.labelling.ledger import Entry, Ledger, Stage
from looktwice.clients.metadrive import simulator
from looktwice.clients.metadrive.generation.blocks import GenerateConfig, write_manifest
from looktwice.model.bundled import SCENES
from looktwice.model.driving.reflection_store import read_reflections
from looktwice.model.driving.scene import NO_PICTURE, LabelledScene
from looktwice.model.driving.scene_store import read_scenes, write_scenes
from looktwice.model.evaluation.ladder import COUNTERFACTUAL, META_ACT, MULTI_ROUND, ROUND_2, WHOLE_DATASET
from looktwice.model.network.checkpoint import load
from looktwice.service.cli.commands import app
from looktwice.service.cli.ladder import LadderScenes, Step, follow, steps_left

TRAINING = ("--learning-rate", "0.001", "--steps", "2")
LADDER = [
    ("counterfactual", "meta-act", "counterfactual"),
    ("multi-round", "meta-act", "multi-round"),
    ("counterfactual", "meta-act", "whole-dataset"),
    ("counterfactual", "counterfactual", "round-2"),
]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> LadderScenes:
    """Two folders with a scene and a manifest each, and one without manifest, as imports are."""
    if not simulator.is_installed():
        pytest.skip("MetaDrive is not installed (make sim)")
    folder = tmp_path_factory.mktemp("train")
    for name in ("mixed", "plain", "recorded"):
        (folder / name).mkdir()
        write_scenes(folder / name / "scenes.parquet", islice(read_scenes(SCENES), 1))
    write_manifest(folder / "mixed", GenerateConfig(drifts=True, lapses=True))
    write_manifest(folder / "plain", GenerateConfig())
    return LadderScenes(folder, SCENES, (folder / "mixed", folder / "plain"))


def left(folder: Path, scenes: LadderScenes) -> list[Step]:
    """What is left in a ladder's folder; every command is one that `looktwice` has, with these options."""
    steps = steps_left(folder, scenes, TRAINING, every=6, processes=1, workers=3)
    commands: Any = typer.main.get_command(app)
    for step in steps:
        words, command = [*step.words, *(("--service", "http://localhost") if step.served else ())], commands
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


def stages_of(steps: Sequence[Step], build: str) -> list[tuple[str, ...]]:
    """The commands of a build, without its folder and without what every one of them has."""
    return [
        (step.words[1], *step.words[3:])
        for step in steps
        if step.words[0] == "build" and Path(step.words[2]).name == f"build-{build}"
    ]


def test_it_begins_with_nothing_but_scenes(scenes: LadderScenes, tmp_path: Path) -> None:
    steps = left(tmp_path, scenes)
    assert trained(steps) == [
        ("read-tracks", "untrained", "tracks"),
        ("language", "tracks", "language"),
        ("ground", "untrained", "ground"),
        ("read-facts", "ground", "facts"),
        ("read-scene", "language", "scene"),
        ("meta-act", "scene", "meta-act"),
        *LADDER,
    ]
    recipes = {step.words[1]: step for step in steps if step.words[0] == "train"}
    assert steps[0] is recipes["create"]
    assert value(recipes["read-scene"], "--vision-from") == str(tmp_path / "facts")
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
    assert served == [META_ACT] * 4 + [COUNTERFACTUAL] * 2
    assert steps[-1].words[0] == "evaluate"


def test_plans_are_followed_before_they_are_judged(scenes: LadderScenes, tmp_path: Path) -> None:
    steps = left(tmp_path, scenes)
    mixed, plain = map(str, scenes.roll_out)
    rolled_out = [("rollout", mixed, "--every", "6"), ("rollout", plain, "--every", "6")]
    labelled = ("label", str(scenes.train), "--plans-per-scene", "6")
    for name in ("round-1", "round-2"):
        assert stages_of(steps, name) == [
            *rolled_out,
            ("outcomes", mixed, "--workers", "3"),
            ("outcomes", plain, "--workers", "3"),
            ("filter", "--outcomes"),
            labelled,
            ("export", "--to", str(tmp_path / f"{name}.parquet"), "--right-outcomes"),
        ]
    # The control labels every scene, as the paper's does, and nobody knows which of its plans hold.
    assert stages_of(steps, "whole") == [
        *rolled_out,
        ("filter", "--everything"),
        labelled,
        ("export", "--to", str(tmp_path / "whole.parquet")),
    ]


def test_it_goes_on_where_it_was(untrained_checkpoint: Path, scenes: LadderScenes, tmp_path: Path) -> None:
    linked(tmp_path, untrained_checkpoint, "untrained", "tracks", "ground")
    assert trained(left(tmp_path, scenes))[:2] == [
        ("language", "tracks", "language"),
        ("read-facts", "ground", "facts"),
    ]
    linked(tmp_path, untrained_checkpoint, META_ACT)
    assert trained(left(tmp_path, scenes)) == LADDER
    (tmp_path / "round-1.parquet").touch()
    steps = left(tmp_path, scenes)
    assert trained(steps) == LADDER
    assert [Path(value(step, "--to")).stem for step in steps if step.words[1] == "export"] == [
        "whole",
        "round-2",
    ]
    linked(tmp_path, untrained_checkpoint, COUNTERFACTUAL, MULTI_ROUND, ROUND_2)
    # What is left follows no plan, so it needs no world.
    nowhere = LadderScenes(SCENES, SCENES)
    assert trained(left(tmp_path, nowhere)) == [LADDER[2]]
    linked(tmp_path, untrained_checkpoint, WHOLE_DATASET)
    assert [step.words[0] for step in left(tmp_path, nowhere)] == ["evaluate"], "only the table is told again"


def here(command: Sequence[str]) -> int:
    """Run a command in this process, which has imported everything."""
    words = command[command.index("looktwice.service.cli") + 1 :]
    return CliRunner().invoke(app, words, catch_exceptions=False).exit_code


def test_a_data_set_is_made_and_learned(brief_checkpoint: Path, generated: Path, tmp_path: Path) -> None:
    """Behind a real service, in real worlds. The table is a test of `evaluate --preset ladder`."""
    linked(tmp_path, brief_checkpoint, META_ACT, MULTI_ROUND, WHOLE_DATASET, ROUND_2)
    training = ("--steps", "2", "--batch-size", "2", "--cache", str(tmp_path / "cache"))
    build = tmp_path / "build-round-1"

    def left_here() -> list[Step]:
        of = LadderScenes(generated, generated)
        return steps_left(tmp_path, of, training, every=4, processes=1, workers=1)

    rollout, outcomes, *judged, learning, table = left_here()
    assert [step.words[1] for step in (rollout, outcomes, *judged, learning)] == [
        *("rollout", "outcomes", "filter", "label", "export", "counterfactual"),
    ]
    follow(rollout, here)
    # Ended in the middle of its outcomes, it begins with the same commands, and none does its work again.
    follow(replace(outcomes, words=(*outcomes.words, "--limit", "1")), here)
    (first,) = entered(build, "outcomes")
    assert left_here() == [rollout, outcomes, *judged, learning, table]
    for step in (rollout, outcomes, *judged):
        follow(step, here)
    assert len(entered(build, "outcomes")) == len(entered(build, "rollout")) > 1
    assert first in entered(build, "outcomes")
    assert left_here() == [learning, table]
    follow(learning, here)
    corrected = [each for each in read_reflections(tmp_path / "round-1.parquet") if each.reflection]
    assert all(each.mend for each in corrected), "a plan that failed leads to one that was followed and held"
    learned = load(tmp_path / COUNTERFACTUAL).card.details["stages"][-1]
    assert learned["name"] == "counterfactual"
    assert learned["reflections_count"] == len(corrected) > 0


def entered(build: Path, stage: Stage) -> list[Entry]:
    """What a stage of a build has done, and when."""
    with Ledger(build) as ledger:
        return list(ledger.entries(ledger.the_run(stage)))


def refusal(scenes: Path, to: Path, *more: str) -> str:
    """What the command says of scenes that it does not take; nothing is begun."""
    asked = ["train", "ladder", "--scenes", str(scenes), "--test", str(SCENES), "--to", str(to), *more]
    result = CliRunner().invoke(app, asked)
    assert result.exit_code == 2
    assert not to.exists()
    return result.output


def test_scenes_in_which_no_plan_can_be_followed_are_refused_at_once(
    scenes: LadderScenes, tmp_path: Path
) -> None:
    everything, to = scenes.train, tmp_path / "ladder"
    told = refusal(everything, to)
    assert f"cannot in {everything / 'recorded'}: " in told
    assert "only scenes of `looktwice scenes generate` have a world to fork" in told
    assert "--roll-out names the scenes" in told
    other = tmp_path / "other.parquet"
    shutil.copy(SCENES, other)
    assert f"{other} is not among the scenes to train on" in refusal(everything, to, "--roll-out", str(other))
    driven, blind = (tmp_path / name for name in ("driven", "blind"))
    for folder, config in (
        (driven, GenerateConfig(driver="nano 0123456789ab", dense=False)),
        (blind, GenerateConfig(pictures=False, dense=False)),
    ):
        folder.mkdir()
        write_scenes(folder / "scenes.parquet", [unseen(each) for each in islice(read_scenes(SCENES), 1)])
        write_manifest(folder, config)
    assert "nano 0123456789ab drove these episodes, not the expert" in refusal(driven, to)
    assert "no pictures to plan from" in refusal(blind, to)
    nested = shutil.copytree(scenes.roll_out[0], tmp_path / "nested")
    inner = shutil.copytree(scenes.roll_out[1], nested / "inner")
    assert f"cannot in {inner}: {nested} holds scenes too" in refusal(nested, to)


def unseen(labelled: LabelledScene) -> LabelledScene:
    """A scene without its pictures."""
    clips = tuple(replace(clip, images=(NO_PICTURE,) * len(clip.images)) for clip in labelled.scene.clips)
    return replace(labelled, scene=replace(labelled.scene, clips=clips))


def test_what_is_no_checkpoint_is_not_begun_with(scenes: LadderScenes, tmp_path: Path) -> None:
    told = refusal(scenes.train, tmp_path / "ladder", "--from", str(tmp_path))
    assert f"{tmp_path} holds no checkpoint" in told


def test_a_step_that_fails_ends_it_and_is_named(scenes: LadderScenes, tmp_path: Path) -> None:
    no_folder, folder = tmp_path / "cache", tmp_path / "ladder"
    no_folder.touch()
    asked = ["train", "ladder", "--scenes", str(scenes.train), "--test", str(SCENES), "--to", str(folder)]
    of_ladders = ["--roll-out", str(scenes.roll_out[0]), "--every", "2", "--processes", "2"]
    result = CliRunner().invoke(app, [*asked, *of_ladders, "--steps", "2", "--cache", str(no_folder)])
    assert result.exit_code == 2
    command = f"train create --to {folder}/untrained --scenes {scenes.train} --cache {no_folder} --steps 2"
    assert f"{command}\n" in result.output, "it is told before it is run"
    assert f"{command} ended with code 2" in result.output


def test_the_papers_recipes_need_a_model_to_begin_with(tmp_path: Path) -> None:
    asked = ["train", "ladder", "--scenes", str(SCENES), "--test", str(SCENES), "--paper"]
    result = CliRunner().invoke(app, [*asked, "--to", str(tmp_path / "ladder")])
    assert result.exit_code == 2
    assert "--from" in result.output
    assert not (tmp_path / "ladder").exists()
