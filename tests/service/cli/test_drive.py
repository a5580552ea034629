"""A car that drives through a real socket, as the command has it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from looktwice.service.cli.commands import app
from looktwice.service.operations.settings import Settings
from tests.checkpoints import write_blind
from tests.service.scripted_engine import CARD, ScriptedEngine
from tests.service.serving import serve

ONE_EPISODE = ["--episodes", "1", "--seconds", "5", "--first-seed", "510000"]


def drove(*arguments: str) -> dict[str, Any]:
    """What `drive` tells of one short episode as JSON."""
    result = CliRunner().invoke(app, ["drive", *ONE_EPISODE, "--json", *arguments])
    assert result.exit_code == 0, result.output
    # The service's log goes where the command prints.
    (told,) = [line for line in map(json.loads, result.stdout.splitlines()) if "drivers" in line]
    assert isinstance(told, dict)
    return told


def test_drives_are_compared_and_kept(tmp_path: Path) -> None:
    engine = ScriptedEngine()
    engine.card_shown = replace(CARD, inputs=("route", "tracks"))
    with serve(engine, Settings()) as served:
        asked = ["--service", served.url, "--n", "1", "--tracks", "--think-threshold", "0.25"]
        asked += ["--keep", str(tmp_path / "drives.jsonl")]
        alone = drove(*asked, "--driver", "never")
        assert alone["comparisons"] == []
        (never,) = alone["drivers"]
        by_never = len(engine.submitted)
        assert never["plans"] == by_never > 0

        all_three = ["--driver", "expert", "--driver", "adaptive", "--driver", "never"]
        told = drove(*asked, *all_three)
        expert, adaptive, kept = told["drivers"]
        assert (expert["name"], expert["route_completion"], expert["plans"]) == ("expert", 1.0, 0)
        assert (adaptive["name"], adaptive["episodes"]) == ("adaptive", 1)
        assert adaptive["plans"] == len(engine.submitted) - by_never > 0
        assert kept["drives"] == never["drives"], "an earlier run's drive is not driven again"
        assert [(each["driver"], each["against"]) for each in told["comparisons"]] == [
            *(("expert", "never"), ("adaptive", "never"))
        ]
        assert told["comparisons"][1]["completion_ratio"] == pytest.approx(adaptive["km"] / never["km"])
        thresholds = [request.controls.think_threshold for request in engine.submitted]
        assert thresholds == [None] * by_never + [0.25] * adaptive["plans"]
        assert all(request.scene.tracks is not None for request in engine.submitted), "as --tracks asks"
        planned = len(engine.submitted)
        assert drove(*asked, *all_three) == told
        assert len(engine.submitted) == planned, "drives that are kept are not driven again"


def test_by_default_nobody_drives_whom_the_format_cannot_be_asked_for() -> None:
    engine = ScriptedEngine()
    engine.card_shown = replace(CARD, formats=("elf_vla",))
    with serve(engine, Settings()) as served:
        told = drove("--service", served.url, "--n", "1")
        assert [driver["name"] for driver in told["drivers"]] == ["expert", "constant velocity", "adaptive"]
        never = CliRunner().invoke(app, ["drive", *ONE_EPISODE, "--service", served.url, "--driver", "never"])
        assert never.exit_code != 0
        assert "cannot be asked for never; ask for adaptive" in never.output


@pytest.fixture
def planners(tmp_path: Path) -> list[Path]:
    """Folders of blind planners: two of different names, and one more of the first name."""
    folders = (tmp_path / "a", tmp_path / "b", tmp_path / "again" / "a")
    return [write_blind(folder, seed) for seed, folder in enumerate(folders)]


def test_small_planners_of_one_kind_have_rows_of_their_own(planners: list[Path], tmp_path: Path) -> None:
    kept, (one, other, _) = tmp_path / "drives.jsonl", planners
    (alone,) = drove("--keep", str(kept), "--small", str(one))["drivers"]
    assert alone["name"] == "blind"
    told = drove("--keep", str(kept), "--small", str(one), "--small", str(other))
    assert [driver["name"] for driver in told["drivers"]] == ["blind a", "blind b"]
    first, second = told["drivers"]
    assert first["drives"] == alone["drives"]
    assert first["km"] != second["km"]
    assert len(kept.read_text().splitlines()) == 2, "it is kept by what it is, not by its name"


def test_small_planners_that_no_name_tells_apart_are_refused(planners: list[Path]) -> None:
    one, _, another = map(str, planners)
    for twice in (["--small", one, "--small", another], ["--small", one, "--small", one]):
        result = CliRunner().invoke(app, ["drive", *twice])
        assert result.exit_code == 2
        assert "'blind a'" in result.output


def test_unknown_drivers_are_refused() -> None:
    result = CliRunner().invoke(app, ["drive", "--driver", "racer"])
    assert result.exit_code == 2
    assert "racer" in result.output


def test_a_driver_drives_once() -> None:
    result = CliRunner().invoke(app, ["drive", "--driver", "never", "--driver", "never"])
    assert result.exit_code == 2
    assert "twice" in result.output


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
