"""What thinking brings, as the command tells it: real engines, an untrained checkpoint, bundled scenes."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene_store import read_scenes, write_scenes
from looktwice.model.engines.engine import Event, PlanRequest
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.service.cli.commands import app
from tests.checkpoints import write_blind
from tests.model.evaluation.test_table import CONTRACT


def ladder(checkpoint: Path, folder: Path, *more: str) -> dict[str, Any]:
    """Over two scenes with two draws each."""
    asked = ["evaluate", "--preset", "ladder", "--checkpoint", str(checkpoint), "--limit", "2", "--n", "2"]
    kept = ["--think-threshold", "0.25", "--sweep", "1", "--keep", str(folder / "draws.sqlite")]
    result = CliRunner().invoke(app, [*asked, *kept, *more, "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout.splitlines()[-1])
    assert isinstance(found, dict)
    return found


def test_a_ladder_is_climbed_once_and_told_again(
    brief_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = tmp_path / "entries"
    entries.mkdir()
    for name in ("meta-act", "multi-round"):
        (entries / name).symlink_to(brief_checkpoint, target_is_directory=True)
    plots = tmp_path / "plots"
    files = ["--plots", str(plots), "--per-scene", str(tmp_path / "scenes.parquet")]
    told = ladder(brief_checkpoint, tmp_path, "--ladder", str(entries), *files)
    scenes = pq.read_table(tmp_path / "scenes.parquet").to_pylist()
    for row in (each for each in told["rows"] if each["subgroup"] is None):
        measured = [scene["min_ade_m"] for scene in scenes if scene["row"] == row["name"]]
        assert sum(measured) / len(measured) == pytest.approx(row["min_ade_m"])
    names = {row["name"] for row in told["rows"]}
    assert {"traj-only", "meta-act", "meta-act, expert plan", "meta-act, multi-round"} <= names
    for way in ("adaptive", "never thinks", "always thinks", "threshold 0", "threshold 1", "temperature 0.2"):
        assert f"counterfactual, {way}" in names
    thinking = "counterfactual, adaptive + route : counterfactual, never thinks + route"
    compared = {each["measure"] for each in told["comparisons"] if each["name"] == thinking}
    assert compared == {"min_ade_m", "avg_ade_m", "collision_rate"}
    assert {path.name for path in plots.iterdir()} == {
        "thinking-by-difficulty.png",
        "thinking-by-temperature.png",
        "risk-and-compute.png",
    }

    planned, submit = set[str](), TorchEngine.submit

    def planning(engine: TorchEngine, request: PlanRequest) -> AsyncGenerator[Event]:
        planned.add(request.scene.scene_id)
        return submit(engine, request)

    monkeypatch.setattr(TorchEngine, "submit", planning)
    assert ladder(brief_checkpoint, tmp_path, "--ladder", str(entries)) == told
    assert not planned & {each.scene.scene_id for each in read_scenes(SCENES)}, "all draws are kept"


def test_a_ladder_that_is_not_there_is_refused(brief_checkpoint: Path, tmp_path: Path) -> None:
    asked = ("evaluate", "--preset", "ladder", "--checkpoint", str(brief_checkpoint), "--limit", "2")
    refused = CliRunner().invoke(app, [*asked, "--ladder", str(tmp_path / "none")])
    assert refused.exit_code == 2
    assert "holds no ladder" in refused.output


def test_scenes_that_a_row_does_not_allow_are_refused_before_the_engine_starts(
    untrained_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = list[TorchEngine]()
    monkeypatch.setattr(TorchEngine, "start", started.append)

    def refusal(*more: str) -> str:
        result = CliRunner().invoke(app, ["evaluate", "--checkpoint", str(untrained_checkpoint), *more])
        assert result.exit_code == 2, result.output
        return result.output

    assert "of these 1 one has 1: take more scenes" in refusal("--limit", "1")
    routeless = [replace(each, scene=replace(each.scene, route=None)) for each in read_scenes(SCENES)]
    write_scenes(tmp_path / "routeless.parquet", routeless)
    assert "has no route" in refusal("--scenes", str(tmp_path / "routeless.parquet"))
    write_scenes(tmp_path / "none.parquet", [])
    assert "no scenes to evaluate on" in refusal("--scenes", str(tmp_path / "none.parquet"))
    assert not started


def test_json_has_the_keys_that_scripts_rely_on_and_a_row_for_each_small_planner(
    brief_checkpoint: Path, tmp_path: Path
) -> None:
    folders = [tmp_path / "a", tmp_path / "b", tmp_path / "again" / "a"]
    for seed, folder in enumerate(folders):
        write_blind(folder, seed)
    asked = ["evaluate", "--checkpoint", str(brief_checkpoint), "--limit", "2", "--n", "1", "--json"]
    one, other, another = (["--small", str(folder)] for folder in folders)
    result = CliRunner().invoke(app, [*asked, *one, *other, "--small", "looktwice-nano"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout.splitlines()[-1])
    assert set(told) == {"scenes", "episodes", "rows", "comparisons", "speed_response"}
    assert all(set(row) >= CONTRACT for row in told["rows"])
    rows = {row["name"]: row for row in told["rows"] if row["subgroup"] is None}
    assert {"blind a", "blind b", "teacher"} < rows.keys(), "a checkpoint that comes along has a name"
    assert rows["blind a"]["agreed_ade_m"] != rows["blind b"]["agreed_ade_m"]
    free = rows["meta-act + route"]
    for measure in ("agreed_ade_m", "greedy_ade_m", "agreement_plan_trajectory"):
        assert isinstance(free[measure], float)
        assert len(free["intervals"][measure]) == 2
    for name in ("meta-act + route", "blind a", "teacher"):
        assert set(told["speed_response"][name]) == {"0.5", "1.5"}

    refused = CliRunner().invoke(app, [*asked, *one, *another])
    assert refused.exit_code == 2
    assert "'blind a'" in refused.output


def test_perception_needs_a_resampler_and_tells_facts_and_gate(
    untrained_checkpoint: Path, resampling_checkpoint: Path
) -> None:
    asked = ["evaluate", "--perception", "--json", "--checkpoint"]
    result = CliRunner().invoke(app, [*asked, str(untrained_checkpoint)])
    assert result.exit_code == 2
    assert "has no resampler" in result.output

    gate = ["--limit", "4", "--gate-scenes", str(SCENES), "--gate-steps", "20"]
    result = CliRunner().invoke(app, [*asked, str(resampling_checkpoint), *gate])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout.splitlines()[-1])
    assert [row["facts"] for row in told["gate"]] == ["none", "read", "true"]
    assert {row["fact"] for row in told["facts"]} >= {"own lane: lead present", "walker present"}
