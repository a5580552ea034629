"""A car that drives through a real socket, as the command has it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from looktwice.service.cli.commands import app
from looktwice.service.operations.settings import Settings
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import serve


def test_drives_are_compared_and_kept(tmp_path: Path) -> None:
    engine = ScriptedEngine()
    with serve(engine, Settings()) as served:

        def driven() -> list[dict[str, Any]]:
            asked = ["drive", "--service", served.url, "--episodes", "1", "--seconds", "5", "--n", "1"]
            drivers = ["--driver", "expert", "--driver", "adaptive", "--think-threshold", "0.25"]
            kept = ["--first-seed", "510000", "--keep", str(tmp_path / "drives.jsonl"), "--json"]
            result = CliRunner().invoke(app, [*asked, *drivers, *kept])
            assert result.exit_code == 0, result.output
            # The service's log goes where the command prints.
            (told,) = [line for line in map(json.loads, result.stdout.splitlines()) if "drivers" in line]
            found = told["drivers"]
            assert isinstance(found, list)
            return found

        expert, adaptive = driven()
        assert (expert["name"], expert["route_completion"], expert["plans"]) == ("expert", 1.0, 0)
        assert (adaptive["name"], adaptive["episodes"]) == ("adaptive", 1)
        asked = len(engine.submitted)
        assert adaptive["plans"] == asked > 0
        assert {request.controls.think_threshold for request in engine.submitted} == {0.25}
        assert driven() == [expert, adaptive]
        assert len(engine.submitted) == asked, "drives that are kept are not driven again"


def test_unknown_drivers_are_refused() -> None:
    result = CliRunner().invoke(app, ["drive", "--driver", "racer"])
    assert result.exit_code == 2
    assert "racer" in result.output


def test_a_film_of_another_kind_is_refused_before_anything_is_driven() -> None:
    result = CliRunner().invoke(app, ["drive", "--service", "http://127.0.0.1:9", "--gif", "film.mp4"])
    assert result.exit_code == 2
    assert ".gif" in result.output


def test_nobody_drives_by_pictures_without_a_small_planner() -> None:
    result = CliRunner().invoke(app, ["drive", "--by", "pictures"])
    assert result.exit_code == 2
    assert "--by" in result.output


def test_a_service_that_does_not_answer_is_named() -> None:
    result = CliRunner().invoke(app, ["drive", "--service", "http://127.0.0.1:9", "--episodes", "1"])
    assert result.exit_code == 2
    assert result.output.startswith("looktwice: http://127.0.0.1:9: ")
    assert len(result.output.splitlines()) == 1
