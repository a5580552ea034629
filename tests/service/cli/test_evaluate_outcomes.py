"""What second looks bring by outcome, as the command tells it: a real engine, real scenes, plans followed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from looktwice.clients.metadrive.outcomes import outcome_store, store
from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene_store import MANIFEST
from looktwice.service.cli.commands import app

DRAWS = 2


def ran(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["evaluate", "--outcomes", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


def told(*arguments: object) -> list[dict[str, Any]]:
    (line,) = [line for line in ran(*arguments, "--json").splitlines() if line.startswith("{")]
    looks = json.loads(line)["second_looks"]
    assert isinstance(looks, list)
    return looks


def test_what_second_looks_bring(generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep = tmp_path / "draws.sqlite"
    asked = ("--scenes", generated, "--limit", 3, "--n", DRAWS, "--workers", 1, "--keep", keep)
    first = told(*asked, "--think-threshold", 0)
    route = first[0]
    assert route["given"] == "route"
    assert (route["scenes"] + route["expert_fails"], route["unpaired"]) == (3, 0)
    assert route["think_rate"] == 1.0
    looks = route["revised_better_by_outcome_count"]
    assert looks == route["scenes"] * DRAWS
    shares = [route[f"revised_{way}_by_outcome"] for way in ("better", "worse")]
    assert 0.0 <= sum(shares) <= 1.0
    assert {"holds", "collision", "behind"} <= route["outcomes"]["never"].keys()

    # Draws and outcomes are in the files: told again, nothing is followed.
    def nothing_left(episodes: Iterator[object], *_: object) -> Iterator[Any]:
        assert list(episodes) == []
        return iter(())

    with monkeypatch.context() as patched:
        patched.setattr(store, "follow_episodes", nothing_left)
        assert told(*asked, "--think-threshold", 0) == first
    # A line that a kill cut short is followed again.
    file = keep.with_name("draws.sqlite.outcomes")
    whole = file.read_text()
    file.write_text(whole[:-20])
    assert told(*asked, "--think-threshold", 0) == first
    assert sorted(file.read_text().splitlines()) == sorted(whole.splitlines())
    assert outcome_store(file).find("another") is None

    # Whoever never takes a second look has none to be judged by; the first plans are the same.
    never = told(*asked, "--think-threshold", 1)[0]
    assert never["think_rate"] == 0.0
    assert never["revised_better_by_outcome"] is None
    assert never["outcomes"]["adaptive"] == never["outcomes"]["never"] == route["outcomes"]["never"]
    assert never["think_outcome_auc"] == route["think_outcome_auc"]


def test_scenes_without_a_world_are_refused_before_anything_is_planned(
    generated: Path, tmp_path: Path
) -> None:
    assert "imported and bundled ones have none" in ran("--scenes", SCENES, code=2)
    driven = tmp_path / "driven"
    shutil.copytree(generated, driven)
    manifest = json.loads((driven / MANIFEST).read_text())
    manifest["config"]["driver"] = "pictures 1"
    (driven / MANIFEST).write_text(json.dumps(manifest))
    assert "pictures 1 drove these episodes, not the expert" in " ".join(
        ran("--scenes", driven, code=2).split()
    )
