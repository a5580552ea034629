"""Checkpoints to begin with, as the command makes them."""

from __future__ import annotations

import json
import re
from itertools import islice
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene_store import read_scenes, write_scenes
from looktwice.model.network.checkpoint import load
from looktwice.model.training.recipes import NANO, PAPER
from looktwice.service.cli.commands import app
from tests.model.network.stock import write_stock
from tests.model.training.scenes import training_scene


def ran(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


def test_a_stock_backbone_is_expanded_and_plans(tmp_path: Path) -> None:
    scenes, stock, expanded = (tmp_path / name for name in ("scenes.parquet", "stock", "expanded"))
    write_scenes(scenes, [training_scene(number) for number in range(4)])
    write_stock(stock, spare_rows=0)
    asked = ("train", "create", "--scenes", scenes, "--cache", tmp_path / "cache")
    made = ran(*asked, "--from", stock, "--to", expanded)
    assert made.exit_code == 0, made.output
    assert "codec" in made.output
    card = load(expanded).card
    assert (card.name, card.formats) == ("expanded", ("cf_vla", "traj_only"))
    planned = ran("plan", scenes, "--checkpoint", expanded, "--n", "1", "--format", "traj_only", "--json")
    assert planned.exit_code == 0, planned.output
    assert len(json.loads(planned.stdout)["draws"][0]["trajectory"]) == 64


@pytest.mark.parametrize(
    ("recipe", "format", "learning_rate"),
    [("traj-only", "traj_only", 1e-5), ("elf-pretrain", "elf_vla", 1e-5), ("elf-sft", "elf_vla", 4e-5)],
)
def test_a_stock_backbone_is_trained_by_the_papers_recipe(
    tmp_path: Path, recipe: str, format: str, learning_rate: float
) -> None:
    scenes, stock, expanded, target = (
        tmp_path / name for name in ("scenes.parquet", "stock", "expanded", recipe)
    )
    write_scenes(scenes, islice(read_scenes(SCENES), 4, 8))
    write_stock(stock, spare_rows=0)
    of = ("--scenes", scenes, "--cache", tmp_path / "cache")
    made = ran("train", "create", *of, "--from", stock, "--to", expanded)
    assert made.exit_code == 0, made.output
    few = ("--steps", "2", "--batch-size", "2")
    trained = ran("train", recipe, "--paper", *of, *few, "--from", expanded, "--to", target)
    assert trained.exit_code == 0, trained.output
    assert format in load(target).card.formats
    (stage,) = load(target).card.details["stages"]
    told = {name: stage[name] for name in ("name", "steps", "batch_size", "learning_rate", "examples")}
    rate = {"learning_rate": learning_rate}
    assert told == {"name": recipe, "steps": 2, "batch_size": 2, "examples": 4} | rate
    assert stage["vision_rate"] == 1.0, "unlike the nano recipe, the paper's trains the tower too"
    logged = json.loads((target / "log.jsonl").read_text())
    assert (logged["stage"], logged["step"]) == (f"1 {recipe}", 2)
    assert 0 < logged["train_loss"] < 50


def test_what_is_no_backbone_is_refused_by_name(tmp_path: Path) -> None:
    scenes = tmp_path / "scenes.parquet"
    write_scenes(scenes, [training_scene(number) for number in range(4)])
    asked = ("train", "create", "--scenes", scenes, "--cache", tmp_path / "cache")
    refused = ran(*asked, "--from", tmp_path / "none", "--to", tmp_path / "made")
    assert refused.exit_code == 2
    assert "no config.json" in refused.output
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("recipe", "ignored"),
    [
        ("branch", ["--failures", "failures.parquet"]),
        ("branch", ["--steps", "5"]),
        ("blind", ["--compiled"]),
        ("meta-act", ["--format", "traj_only"]),
    ],
)
def test_options_that_a_recipe_would_ignore_are_refused(
    tmp_path: Path, recipe: str, ignored: list[str]
) -> None:
    scenes = tmp_path / "scenes.parquet"
    write_scenes(scenes, [training_scene(0)])
    refused = ran("train", recipe, "--scenes", scenes, "--to", tmp_path / "made", "--threads", "2", *ignored)
    assert refused.exit_code == 2
    assert f"{recipe} takes no {ignored[0]}" in refused.output
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ([], "give the format to teach"),
        (["--format", "traj_only", "--paper"], "respond takes no --paper"),
        (
            ["--format", "traj_only", "--weigh", "trajectory"],
            "SECTION=WEIGHT, not 'trajectory'",
        ),
        (["--format", "traj_only", "--weigh", "trajectory=-1"], "a weight is 0 or more"),
        (["--format", "traj_only", "--weigh", "plan=2"], "no section 'plan'"),
    ],
)
def test_a_format_that_cannot_be_taught_is_refused(tmp_path: Path, given: list[str], told: str) -> None:
    refused = ran("train", "respond", "--scenes", tmp_path, "--to", tmp_path / "made", *given)
    assert refused.exit_code == 2
    assert told in refused.output
    assert not (tmp_path / "made").exists()


def test_every_recipe_is_named_where_they_are_listed(tmp_path: Path) -> None:
    asked = ("--scenes", tmp_path, "--to", tmp_path / "made")
    refused = ran("train", "no-recipe", *asked).output
    known = refused.removeprefix("looktwice: unknown recipe 'no-recipe'; known are ").strip().split(", ")
    assert {"create", "branch", "ladder", "blind", "composer", *NANO} <= set(known)
    papers = ran("train", "no-recipe", "--paper", *asked).output
    told = re.sub(r"[^a-z0-9,;:.-]+", " ", ran("train", "--help").output)
    commands = (Path(__file__).parents[3] / "docs" / "commands.md").read_text()
    [row] = [line for line in commands.splitlines() if line.startswith("| `looktwice train RECIPE`")]
    for name in known:
        assert re.search(rf"(?<![\w-]){name}(?![\w-])", told), name
        assert f"`{name}`" in row, name
    assert all(name in papers and name in known for name in PAPER)
