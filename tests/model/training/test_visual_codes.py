from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from typer.testing import CliRunner

from looktwice.model.driving.images import encode_png
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, Clip, LabelledScene
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.network.visual_codes import VisualCodes, frame_of, load_visual_codes, psnr
from looktwice.model.training.recipes import VISUAL_CODES
from looktwice.model.training.visual_codes import (
    SHEET_FILE,
    FrameDataset,
    VisualCodesLearner,
    clips_of,
    held_out,
    picture_figures,
    spread,
    train_visual_codes,
)
from looktwice.service.cli.commands import app
from tests.model.driving.drives import labelled_scene

SHORT = replace(VISUAL_CODES, steps=60, batch_size=4, warmup_steps=5, learning_rate=3e-3)


def road(seed: int) -> bytes:
    """A picture of sky, land and a road with a car on it."""
    random = np.random.default_rng(seed)
    picture = Image.new("RGB", (224, 112), (150, 200, 240))
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, 40, 224, 112), fill=(90, 130, 70))
    draw.polygon([(112, 40), (200, 112), (24, 112)], fill=(110, 110, 110))
    x, y = int(random.integers(80, 140)), int(random.integers(50, 80))
    draw.rectangle((x, y, x + 20, y + 12), fill=tuple(map(int, random.integers(0, 256, 3))))
    return encode_png(np.asarray(picture))


def filmed_scene(index: int) -> LabelledScene:
    """Two cameras; the last two pictures of a clip are the same."""
    clips = []
    for number, camera in enumerate((FRONT_WIDE, FRONT_TELE)):
        first, second, third = (road(100 * index + 10 * number + frame) for frame in range(3))
        clips.append(Clip(camera, (first, second, third, third)))
    made = labelled_scene(scene_id=f"scene-{index}")
    return replace(made, scene=replace(made.scene, clips=tuple(clips)), seed=index // 2)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    write_scenes(folder / "a.parquet", [filmed_scene(index) for index in range(12)])
    return folder


def test_pictures_are_learned(scenes: Path, tmp_path: Path) -> None:
    figures = train_visual_codes(SHORT, scenes, tmp_path, width=24, measured_clips=3, validate_every=20)
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    measured = [row for row in rows if "psnr_db" in row]
    assert [row["step"] for row in measured] == [20, 40, 60]
    # What is written is what was measured last.
    assert figures["psnr_db"] == pytest.approx(measured[-1]["psnr_db"])
    clips = list(clips_of(filmed_scene(index) for index in range(2)))
    untrained = picture_figures(VisualCodes(24), clips)["psnr_db"]
    assert picture_figures(load_visual_codes(tmp_path), clips)["psnr_db"] > untrained + 2
    # Three pictures side by side, each above what became of it.
    with Image.open(tmp_path / SHEET_FILE) as sheet:
        assert sheet.size == (3 * 228 - 4, 2 * 112 + 4)


def test_figures() -> None:
    torch.manual_seed(0)
    [clip, *_] = clips_of([filmed_scene(0)])
    figures = picture_figures(VisualCodes(24), [clip])
    assert figures["pictures"] == 4
    assert 0 < figures["codes_used"] <= 0.392  # 4 x 98 of 1000
    # The last picture is the one before: a third of the pairs is the same.
    assert 1 / 3 <= figures["codes_kept"] < 1
    assert figures["patch_psnr_db"] > 15


def test_psnr() -> None:
    grey = np.full((112, 224, 3), 100, np.uint8)
    assert psnr(grey, grey + 10) == pytest.approx(20 * np.log10(25.5))
    assert psnr(grey, grey) < 60


def test_every_tenth_episode_is_held_out() -> None:
    clips = clips_of(replace(filmed_scene(0), seed=seed) for seed in range(21))
    learned, others = held_out(clips)
    assert sorted({clip.episode for clip in others}) == [0, 10, 20]
    assert len(learned) == 2 * 18
    with pytest.raises(ValueError, match="one episode"):
        held_out(clips[:2])


def test_clips_are_spread() -> None:
    clips = clips_of(replace(filmed_scene(0), seed=seed) for seed in range(5))
    assert [clip.episode for clip in spread(clips, 4)] == [0, 1, 3, 4]
    assert spread(clips, 99) == clips


def test_frames_are_those_of_the_clips_or_mirrored() -> None:
    clips = clips_of([filmed_scene(0)])
    seen = FrameDataset(clips)
    whole = {seen[0].tobytes() for _ in range(60)}
    plain = [frame_of(image) for image in set(clips[0].images)]
    assert whole == {frame.tobytes() for frame in plain} | {frame[:, ::-1].tobytes() for frame in plain}


class _Painter(VisualCodes):
    """Paints what it saw, a little too bright."""

    def __init__(self, brighter: float) -> None:
        super().__init__(24)
        self.brighter = brighter

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        return pictures + self.brighter, pictures


def test_the_loss_is_that_of_colours_and_edges() -> None:
    pictures = torch.rand(2, 3, 112, 224, generator=torch.Generator().manual_seed(0))
    assert VisualCodesLearner(_Painter(0.0))(pictures)["loss"] == 0
    losses = VisualCodesLearner(_Painter(0.1))(pictures)
    assert float(losses["colour_loss"]) == pytest.approx(0.1, abs=1e-5)
    assert float(losses["edge_loss"]) == pytest.approx(0.0, abs=1e-5)
    assert float(VisualCodesLearner(VisualCodes(24))(pictures)["edge_loss"].detach()) > 0


_SCRIPT = """
import sys
from dataclasses import replace
from pathlib import Path
from looktwice.model.training.recipes import VISUAL_CODES
from looktwice.model.training.visual_codes import train_visual_codes
recipe = replace(VISUAL_CODES, steps=20, batch_size=2, warmup_steps=1)
few = {"width": 24, "measured_clips": 1, "save_every": 2, "validate_every": 1}
train_visual_codes(recipe, Path(sys.argv[1]), Path(sys.argv[2]), **few)
"""


def test_a_killed_run_goes_on(scenes: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-c", _SCRIPT, str(scenes), str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 300
    while not list((tmp_path / "state").glob("checkpoint-[4-9]")) and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "visual_codes.safetensors").exists()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    load_visual_codes(tmp_path)
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    steps = [row["step"] for row in rows if "psnr_db" in row]
    assert set(steps) == set(range(1, 21))
    # The second run did not begin anew.
    assert steps.count(1) == steps.count(2) == 1


def test_the_command(scenes: Path, tmp_path: Path) -> None:
    asked = ["train", "visual-codes", "--scenes", str(scenes), "--to", str(tmp_path / "codes")]
    refused = CliRunner().invoke(app, [*asked, "--from", str(tmp_path)])
    assert refused.exit_code == 2
    assert "leave --from out" in refused.output
    done = CliRunner().invoke(
        app,
        [*asked, "--validation", str(scenes), "--steps", "2", "--batch-size", "2"],
        catch_exceptions=False,
    )
    assert done.exit_code == 0, done.output
    assert "psnr_db " in done.output
    assert {path.name for path in (tmp_path / "codes").iterdir()} >= {
        "visual_codes.safetensors",
        "log.jsonl",
        "pictures.png",
        "curves.png",
    }
