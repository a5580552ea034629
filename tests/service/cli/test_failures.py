"""`looktwice failures`: a real service, real commands."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from looktwice.model.driving.feedback_store import read_feedback
from looktwice.model.driving.pdm.feedback import Feedback, parse_feedback
from looktwice.service.cli.commands import app
from looktwice.service.operations.settings import Settings
from tests.clients.labelling.builds import scenes
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve


def test_responses_are_judged_sampled_and_written_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("LOOKTWICE_TEACHER_KIND", raising=False)
    file, folder = scenes(tmp_path, 4), tmp_path / "failures"
    engine = ScriptedEngine()

    def ran(url: str, *options: str) -> dict[str, object]:
        command = ["failures", str(folder), str(file), "--service", url, "--json", *options]
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
        lines = [json.loads(line) for line in result.output.splitlines() if line.startswith("{")]
        (told,) = [line for line in lines if "event" not in line]
        assert isinstance(told, dict)
        return told

    with serve(engine, Settings(bundled_scenes=tmp_path / "none")) as served:
        first = ran(served.url, "--threshold", "0.5", "--wrong", "3")
        again = ran(served.url, "--threshold", "0.5", "--wrong", "3")
        assert (first["inferred"], first["inference_dead"]) == (4, 0)
        assert (again["done"], again["earlier"]) == (0, first["done"])
        assert len(engine.submitted) == 4
        assert {asked.format for asked in engine.submitted} == {"cf_vla"}
        strict = ran(served.url, "--threshold", "1", "--to", str(tmp_path / "strict.parquet"))
        assert len(engine.submitted) == 4
        assert (strict["correct"], strict["wrong"]) == (0, 8)
        ran(served.url, "--threshold", "0.5", "--format", "traj_only", "--to", str(tmp_path / "at once"))
        assert [asked.format for asked in engine.submitted[4:]] == ["traj_only"] * 4
    found = list(read_feedback(folder / "feedback.parquet"))
    assert (sum(row.correct for row in found), sum(not row.correct for row in found)) == (
        first["correct"],
        first["wrong"],
    )
    assert first["wrong"] == 3 or first["correct"] == 8
    for row in read_feedback(tmp_path / "strict.parquet"):
        assert isinstance(parse_feedback(row.feedback), Feedback)
        assert (row.teacher, row.threshold, row.version, len(row.trajectory)) == ("rules", 1.0, "v1.1", 64)
        assert json.loads(row.facts)


def test_a_service_that_is_loading_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LOOKTWICE_TEACHER_KIND", raising=False)
    engine = ScriptedEngine()
    engine.may_start.clear()
    asked = ["failures", str(tmp_path / "failures"), str(scenes(tmp_path, 1))]
    with serve(engine, Settings(bundled_scenes=tmp_path / "none"), wait=False) as served:
        asked += ["--service", served.url]
        given_up = CliRunner().invoke(app, [*asked, "--give-up-after", "0.5"])
        assert given_up.exit_code == 2
        assert "the model is loading" in given_up.output
        waiting = threading.Timer(0.5, served.in_loop, [engine.may_start.set])
        waiting.start()
        result = CliRunner().invoke(app, asked)
        waiting.join()
    assert result.exit_code == 0, result.output


def test_nobody_answers_is_one_line(tmp_path: Path) -> None:
    command = ["failures", str(tmp_path / "f"), str(scenes(tmp_path, 1)), "--service", "http://127.0.0.1:9"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2
    assert "no service answers" in result.output
