"""Checkpoints that LookTwice did not write: planned with, evaluated and served."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

import looktwice.clients.wire as wire
from looktwice.clients.planner import PlannerClient, PlannerError, plan_request
from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene_store import read_scenes
from looktwice.service.cli.commands import app
from looktwice.service.cli.engines import make_engine
from looktwice.service.operations.settings import Settings
from tests.foreign import byte_level_tokenizer, write_llm, write_vlm
from tests.service.serving import serve

RUNNER = CliRunner()
SCENE = next(iter(read_scenes(SCENES))).scene
FOREIGN = ["--engine", "transformers", "--format", "elf_vla"]


@pytest.fixture(scope="module")
def llm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_llm(tmp_path_factory.mktemp("foreign") / "llm", byte_level_tokenizer())


def run(*arguments: str) -> str:
    result = RUNNER.invoke(app, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_it_plans_for_scenes_and_for_requests(llm: Path, tmp_path: Path) -> None:
    plan = ["plan", "--checkpoint", str(llm), "--out", str(tmp_path), "--json"]
    told = json.loads(run(*plan, *FOREIGN, "--n", "2"))
    assert [len(draw["trajectory"]) for draw in told["draws"]] == [8, 8]
    assert all(draw["text"].startswith("<think>") for draw in told["draws"])
    # A request names its format itself.
    body = plan_request(SCENE, wire.Controls(n=2)).model_copy(update={"format": "elf_vla"})
    request = tmp_path / "request.json"
    request.write_text(body.model_dump_json())
    again = json.loads(run(*plan, str(request), "--engine", "transformers"))
    assert all(draw["text"].startswith("<think>") for draw in again["draws"])


def test_it_is_evaluated(llm: Path) -> None:
    told = json.loads(
        run("evaluate", "--checkpoint", str(llm), *FOREIGN, "--limit", "1", "--n", "1", "--json")
    )
    planned = {row["name"]: row["agreed_ade_m"] for row in told["rows"] if row["output_tokens"]}
    assert planned
    assert all(ade_m > 0 for ade_m in planned.values())


def test_it_is_served_with_pictures(tmp_path: Path) -> None:
    folder = write_vlm(tmp_path / "vlm")
    engine = make_engine(folder, 8, name="transformers", formats=["elf_vla"])
    with serve(engine, Settings()) as served, PlannerClient(served.url) as planner:
        [card] = planner.models()
        assert (card.name, card.formats, card.inputs) == ("vlm", ["elf_vla"], ["route", "tracks"])
        assert card.cameras == ["front_wide_120", "front_tele_30"]
        result = planner.plan(SCENE, wire.Controls(n=2, logprobs=True))
        assert [len(draw.trajectory) for draw in result.draws] == [8, 8]
        for controls in (wire.Controls(bind=True), wire.Controls(thinking="always")):
            with pytest.raises(PlannerError):
                planner.plan(SCENE, controls)


def test_what_does_not_fit_together_is_refused(llm: Path, untrained_checkpoint: Path) -> None:
    for arguments, message in (
        (["--checkpoint", str(llm)], "foreign ones need --engine transformers and --format NAME"),
        (["--checkpoint", str(llm), "--engine", "transformers"], "name a response format with --format"),
        (["--checkpoint", str(llm), *FOREIGN[:3], "cf_vla"], "its responses hold codes (trajectory)"),
        (["--checkpoint", str(untrained_checkpoint), *FOREIGN], "leave out --format"),
    ):
        result = RUNNER.invoke(app, ["evaluate", "--limit", "1", *arguments])
        assert result.exit_code == 2
        assert message in result.stderr
