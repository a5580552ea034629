"""What imagination brings, as the command tells it: a real engine, an untrained checkpoint that imagines."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from looktwice.model.driving.images import decode_image, encode_png
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, LabelledScene, NextFrame
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.network.checkpoint import load, save
from looktwice.model.network.visual_codes import VisualCodes
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.service.cli.commands import app
from tests.checkpoints import write_untrained
from tests.model.driving.drives import agent, labelled_scene

MEASURES = {"l2_1s_m", "l2_2s_m", "l2_3s_m", "l2_m"}
ASKED = "always, camera asked for"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = VlaSettings(name="world", formats=("traj_only", "vla_world"), reflection="phrases")
    folder = tmp_path_factory.mktemp("world") / "checkpoint"
    loaded = load(write_untrained(folder, narrow=True, settings=settings))
    save(folder, loaded.model, loaded.vocabulary, loaded.codec, visual_codes=VisualCodes(24))
    return folder


def scene(number: int, next_frames: int = 2) -> LabelledScene:
    labelled = labelled_scene(
        5.0 + number,
        scene_id=f"scene-{number}",
        episode_id=f"episode-{number}",
        # One overtakes into the wide view, and one crosses into the narrow one.
        agents=(
            agent(-2.0, 3.5, speed=25.0 + number),
            agent(30.0, 12.0, speed=20.0, heading=-np.pi / 2, agent_id=2),
        ),
        pictures=number,
    )
    frame = np.random.default_rng(number).integers(0, 256, (112, 224, 3), np.uint8)
    came = tuple(NextFrame(camera, encode_png(frame)) for camera in (FRONT_WIDE, FRONT_TELE)[:next_frames])
    return replace(labelled, next_frames=came, seed=number)


def evaluated(checkpoint: Path, scenes: list[LabelledScene], folder: Path, *more: str) -> Result:
    write_scenes(folder / "scenes.parquet", scenes)
    asked = ["evaluate", "--preset", "imagination", "--checkpoint", str(checkpoint), "--n", "2", *more]
    return CliRunner().invoke(app, [*asked, "--scenes", str(folder / "scenes.parquet")])


def test_tables_with_and_without_pictures(checkpoint: Path, tmp_path: Path) -> None:
    scenes = [scene(number) for number in range(2)]
    kept = ["--keep", str(tmp_path / "draws.sqlite")]
    result = evaluated(checkpoint, scenes, tmp_path, "--json", *kept, "--plots", str(tmp_path / "plots"))
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout.splitlines()[-1])
    more = ["shuffled images", "thinks of nobody"]
    more += ["given what came", "given the last frame, moved", "given another scene's"]
    rows = ["auto", "never", "always", ASKED, *(f"{ASKED}, {each}" for each in more)]
    for protocol in ("ST-P3", "UniAD"):
        named = {row["name"]: row for row in told["waypoints"][protocol]}
        assert list(named) == ["constant velocity", "constant turn rate", *rows]
        assert all(row["scenes"] == 2 and row.keys() >= MEASURES for row in named.values())
        assert named["constant velocity"]["l2_3s_m"] == pytest.approx(0, abs=1e-4)
        assert named["never"]["l2_m"] > 1
    sheet = decode_image((tmp_path / "plots" / "imagined.png").read_bytes())
    for row, labelled in enumerate(scenes):
        # Both cameras bring the same.
        came, _ = labelled.next_frames
        np.testing.assert_array_equal(sheet[row * 116 : row * 116 + 112, 456:], decode_image(came.image))
    assert sheet.shape == (228, 680, 3)
    passes = {row["name"]: row for row in told["responses"]}
    assert (passes["never"]["imagine_rate"], passes["always"]["imagine_rate"]) == (0.0, 1.0)
    # Without a camera there is nothing to guess from: every code takes a pass.
    assert passes["always"]["passes"] > passes["never"]["passes"] + 90
    assert list(told["actions"]) == rows
    words = [score["action"] for score in told["actions"]["never"]]
    assert words == ["left", "forward", "right", "keep", "accelerate", "decelerate", "stop"]
    pictures = {row["name"]: row for row in told["pictures"]}
    assert set(pictures) == {
        *rows[3:5],
        "the last frame",
        "the last frame, moved as the ego",
        "the last frame, moved as the ego, through its codes",
        "what came, through its codes",
    }
    assert all(row["frechet"] > 0 and len(row["intervals"]["psnr_db"]) == 2 for row in pictures.values())
    # Both of them in both scenes.
    assert [row["scenes"] for row in told["entering"]] == [4, 4]
    entered = {row["name"]: row["shown"] for row in told["entering"]}
    assert list(entered) == [ASKED, "what came, through its codes"]
    assert all(0 <= shown <= 1 for shown in entered.values())
    assert told["extractor"] == "vision tower of world"
    compared = {(each["name"], each["measure"]) for each in told["comparisons"]}
    assert ("always : never (ST-P3)", "l2_m") in compared
    assert (f"{ASKED} : the last frame", "feature_distance") in compared

    text = evaluated(checkpoint, scenes, tmp_path, *kept)
    assert text.exit_code == 0, text.output
    for title in (
        "waypoints, ST-P3",
        "waypoints, UniAD",
        "responses",
        "actions, F1",
        "pictures, by the vision",
    ):
        assert title in text.stdout


def test_what_cannot_imagine_is_refused_by_name(
    checkpoint: Path, untrained_checkpoint: Path, tmp_path: Path
) -> None:
    scenes = [scene(number) for number in range(2)]
    refused = evaluated(untrained_checkpoint, scenes, tmp_path)
    assert refused.exit_code == 2
    assert "writes no format that imagines pictures" in refused.output
    (checkpoint / "visual_codes.safetensors").rename(tmp_path / "codes")
    try:
        refused = evaluated(checkpoint, scenes, tmp_path)
    finally:
        (tmp_path / "codes").rename(checkpoint / "visual_codes.safetensors")
    assert refused.exit_code == 2
    assert "has no codes of pictures" in refused.output
    refused = evaluated(checkpoint, [scene(0, next_frames=0)], tmp_path)
    assert refused.exit_code == 2
    assert "brings no picture half a second ahead" in refused.output
