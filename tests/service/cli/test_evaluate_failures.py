"""Stages of learning from failures, as the command tells them: a real engine, an untrained checkpoint."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from looktwice.model.bundled import CHECKPOINTS, SCENES
from looktwice.service.cli.commands import app
from looktwice.service.cli.evaluate_failures import stages_named


def evaluated(*more: str) -> Result:
    asked = ["evaluate", "--preset", "failures", "--scenes", str(SCENES), "--limit", "2", "--n", "1"]
    return CliRunner().invoke(app, [*asked, *more])


def test_stages_are_told_in_json_and_in_tables(refining_checkpoint: Path, tmp_path: Path) -> None:
    stages = [f"--stage={name}={refining_checkpoint}" for name in ("sft", "rl")]
    kept = ["--keep", str(tmp_path / "draws.sqlite")]
    result = evaluated(*stages, *kept, "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout.splitlines()[-1])
    [sft, rl] = told["stages"]
    assert (sft["name"], rl["name"], sft["scenes"]) == ("sft", "rl", 2)
    # The same checkpoint, asked the same.
    assert sft | {"name": "rl"} == rl
    # Untrained poses lead anywhere: they fail, and their refinements are scored.
    assert sft["failed"] > 0
    assert 0 <= sft["after"] <= 1
    assert [row["name"] for row in told["scores"]["epdms"]][-2:] == ["sft", "rl"]
    compared = {each["name"]: each["difference"] for each in told["comparisons"]}
    assert compared["rl : sft"] == 0
    assert 0 <= sft["again"] <= 1
    assert {"sft, failed: refined : draft", "sft, failed: refined : drawn once more"} <= compared.keys()

    text = evaluated(*stages, *kept)
    assert text.exit_code == 0, text.output
    assert "refine@1, below 0.8" in text.stdout


def test_what_writes_no_such_answers_is_refused_by_name(untrained_checkpoint: Path) -> None:
    refused = evaluated("--checkpoint", str(untrained_checkpoint))
    assert refused.exit_code == 2
    assert "writes no answers that could be refined" in refused.output


def test_stages_have_names_of_their_own() -> None:
    assert stages_named(["runs/elf", "rl=runs/rl"]) == {"elf": Path("runs/elf"), "rl": Path("runs/rl")}
    assert stages_named(["refining=elf-nano"]) == {"refining": CHECKPOINTS["elf-nano"]}
    with pytest.raises(ValueError, match="two stages are called 'rl'"):
        stages_named(["runs/rl", "rl=runs/other"])
