"""`looktwice score`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from typer.testing import CliRunner

from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene_store import read_scenes, write_scenes
from looktwice.service.cli.commands import app
from looktwice.service.routes.request_examples import example_score

RUNNER = CliRunner()


def test_a_request_is_scored_as_over_http(tmp_path: Path) -> None:
    path = tmp_path / "request.json"
    path.write_text(json.dumps({**example_score(), "version": "v1.1"}))
    told = RUNNER.invoke(app, ["score", str(path), "--json"])
    assert told.exit_code == 0, told.output
    scores = json.loads(told.stdout)["scores"]
    assert scores[0]["score"] > scores[1]["score"] == 0
    text = RUNNER.invoke(app, ["score", "-"], input=json.dumps(example_score())).stdout
    assert "progress against idm; missing: extended_comfort" in text
    assert "no_at_fault_collisions with leader 0.00 m" in text


def test_a_wrong_request_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "request.json"
    path.write_text(json.dumps({**example_score(), "trajectories": [[[0.0, 0.0, 0.0]] * 9]}))
    told = RUNNER.invoke(app, ["score", str(path)])
    assert told.exit_code == 2
    assert told.stderr == (
        "looktwice: A trajectory cannot be taken: "
        "/trajectories/0: has 9 poses; 8 at 0.5 s or 64 at 0.1 s are scored\n"
    )


def test_a_scene_file_is_scored_planner_by_planner(tmp_path: Path, untrained_checkpoint: Path) -> None:
    asked = ["score", str(SCENES), "--limit", "2", "--checkpoint", str(untrained_checkpoint), "--n", "2"]
    result = RUNNER.invoke(app, [*asked, "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout.splitlines()[-1])
    expert, constant, *_, checkpoint = told["pdms"]
    assert (expert["name"], constant["name"]) == ("expert", "constant velocity")
    assert len({row["name"] for row in told["pdms"]}) == 4
    assert expert["score"] > 0.9
    assert expert["scenes"] == checkpoint["scenes"] == 2
    assert told["epdms"][0]["score"] > 0.9
    assert told["epdms"][0]["missing"] == {}


def test_what_scenes_from_before_lane_maps_lack_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scenes.parquet"
    write_scenes(path, [replace(next(read_scenes(SCENES)), lane_map=None)])
    result = RUNNER.invoke(app, ["score", str(path), "--json"])
    assert result.exit_code == 0, result.output
    expert = json.loads(result.stdout.splitlines()[-1])["epdms"][0]
    assert expert["score"] is None
    assert set(expert["missing"]) == {
        *("driving_direction_compliance", "traffic_light_compliance", "lane_keeping"),
    }


def test_a_checkpoint_of_eight_poses_is_scored_too(refining_checkpoint: Path) -> None:
    asked = ["score", str(SCENES), "--limit", "2", "--checkpoint", str(refining_checkpoint), "--n", "2"]
    result = RUNNER.invoke(app, [*asked, "--json"])
    assert result.exit_code == 0, result.output
    *_, checkpoint = json.loads(result.stdout.splitlines()[-1])["pdms"]
    assert (checkpoint["scenes"], checkpoint["missing"]) == (2, {})


def test_a_folder_without_scenes_is_one_line(tmp_path: Path) -> None:
    result = RUNNER.invoke(app, ["score", str(tmp_path)])
    assert result.exit_code == 2
    assert result.stderr == f"looktwice: {tmp_path} holds no .parquet scene files\n"
