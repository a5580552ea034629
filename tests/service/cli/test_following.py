"""`scenes follow` and `train critic`: from generated scenes to a checkpoint that doubts its sketches."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.followed_store import read_followed, write_followed
from looktwice.model.network.checkpoint import load
from looktwice.service.cli.commands import app


def followed(scenes: Path, out: Path, *more: object) -> dict[str, int]:
    asked = ["scenes", "follow", str(scenes), str(out), "--small", str(CHECKPOINT), "--by", "pictures"]
    done = CliRunner().invoke(app, [*asked, "--json", *map(str, more)])
    assert done.exit_code == 0, done.output
    counts: dict[str, int] = json.loads(done.stdout)
    return counts


def test_from_scenes_to_a_critic(generated: Path, tmp_path: Path) -> None:
    out = tmp_path / "followed.parquet"
    counts = followed(generated, out, "--also", 2, "--workers", 1)
    rows = list(read_followed(out))
    scenes = {row.scene_id for row in rows}
    assert len(rows) == 3 * len(scenes) == sum(counts.values()) - counts.get("expert fails", 0)
    assert {row.verdict for row in rows} == set(counts) - {"expert fails", "not followed"}
    assert sum(row.mend == "" for row in rows) == len(scenes)
    known = out.with_name("followed.parquet.outcomes").read_bytes()
    out.unlink()
    assert followed(generated, out, "--also", 2, "--workers", 1) == counts
    assert out.with_name("followed.parquet.outcomes").read_bytes() == known, "nothing is followed again"
    target = tmp_path / "critic"
    asked = ["train", "critic", "--scenes", str(generated), "--from", str(CHECKPOINT), "--to", str(target)]
    asked += ["--cache", str(tmp_path / "cache"), "--steps", "3", "--batch-size", "8"]
    refused = CliRunner().invoke(app, asked)
    assert refused.exit_code == 2
    assert "needs followed trajectories" in refused.output
    more = tmp_path / "more.parquet"
    refused = CliRunner().invoke(app, [*asked, "--followed", str(out), "--followed", str(more)])
    assert refused.exit_code == 2
    assert "more.parquet" in refused.output
    write_followed(more, [row for row in rows if row.mend])
    done = CliRunner().invoke(app, [*asked, "--followed", str(out), "--followed", str(more)])
    assert done.exit_code == 0, done.output
    made = load(target)
    assert made.settings.second_sketch
    assert [stage["name"] for stage in made.card.details["stages"]][-1] == "critic"


def test_scenes_without_a_world_are_refused(tmp_path: Path) -> None:
    asked = ["scenes", "follow", str(SCENES), str(tmp_path / "f.parquet"), "--small", str(CHECKPOINT)]
    done = CliRunner().invoke(app, [*asked, "--by", "pictures"])
    assert done.exit_code == 2
    assert "world to fork" in done.output
    assert not list(tmp_path.iterdir())


def test_other_recipes_take_none(generated: Path, tmp_path: Path) -> None:
    asked = ["train", "read-scene", "--scenes", str(generated), "--from", str(CHECKPOINT)]
    asked += ["--to", str(tmp_path / "out"), "--followed", str(tmp_path / "f.parquet")]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 2
    assert "takes no followed trajectories" in done.output
