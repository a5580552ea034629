"""`train critic`: from generated scenes to a checkpoint that doubts its sketches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from typer.testing import CliRunner

from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.scene_store import read_scenes, write_scenes
from looktwice.model.network.checkpoint import load
from looktwice.service.cli.commands import app


def train(scenes: Path, folder: Path, *more: str) -> tuple[int, str]:
    asked = [
        "train",
        "critic",
        "--scenes",
        str(scenes),
        "--from",
        str(CHECKPOINT),
        "--to",
        str(folder / "critic"),
    ]
    asked += ["--cache", str(folder / "cache"), "--steps", "3", "--batch-size", "8", *more]
    done = CliRunner().invoke(app, asked)
    return done.exit_code, done.output


def test_from_scenes_to_a_critic(tmp_path: Path) -> None:
    code, output = train(SCENES, tmp_path, "--workers", "1")
    assert code == 0, output
    made = load(tmp_path / "critic")
    assert made.settings.second_sketch
    assert [stage["name"] for stage in made.card.details["stages"]][-1] == "critic"


def test_scenes_that_tell_no_lanes_are_refused(tmp_path: Path) -> None:
    bare = [replace(each, lane_map=None) for each in read_scenes(SCENES)]
    write_scenes(tmp_path / "bare.parquet", bare)
    code, output = train(tmp_path / "bare.parquet", tmp_path)
    assert code == 2
    assert "no scene tells its route, its road and its lanes" in output
    assert not (tmp_path / "critic" / "model.safetensors").exists()
