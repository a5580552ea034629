"""`looktwice feedback`."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from looktwice.service.cli.commands import app
from looktwice.service.routes.request_examples import example_feedback

RUNNER = CliRunner()


def test_a_request_is_told_as_over_http(tmp_path: Path) -> None:
    path = tmp_path / "request.json"
    path.write_text(json.dumps(example_feedback()))
    told = RUNNER.invoke(app, ["feedback", str(path), "--json"])
    assert told.exit_code == 0, told.output
    assert [each["correct"] for each in json.loads(told.stdout)["feedback"]] == [True, False]
    text = RUNNER.invoke(app, ["feedback", "-"], input=path.read_text()).stdout
    assert "1: score 0.0000, wrong at 0.8\n<feedback>\n**1. Meta action analysis:**" in text


def test_a_wrong_request_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "request.json"
    path.write_text(json.dumps({**example_feedback(), "threshold": 2}))
    told = RUNNER.invoke(app, ["feedback", str(path)])
    assert told.exit_code == 2
    assert told.stderr.startswith("looktwice: The request breaks the contract: /threshold")
