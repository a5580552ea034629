from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from looktwice.model.driving.scene import LabelledScene, NextFrame
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.engines.engine import Draw, PlanRequest
from looktwice.model.engines.torch.in_process import draws_of
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.families.picture_codes import LEVELS, codes_of
from looktwice.model.network.card import LOG_FILE
from looktwice.model.network.checkpoint import load, save
from looktwice.model.network.visual_codes import VisualCodes, frame_of, load_visual_codes
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.training import written_pictures
from looktwice.model.training.composer import (
    WRITTEN_FILE,
    ComposerLearner,
    PairDataset,
    collate_pairs,
    composed_figures,
    pairs_of,
    train_composer,
)
from looktwice.model.training.recipes import COMPOSER
from looktwice.model.training.visual_codes import SHEET_FILE
from looktwice.service.cli.commands import app
from tests.checkpoints import write_untrained
from tests.model.training.test_visual_codes import filmed_scene, road

SHORT = replace(COMPOSER, steps=40, batch_size=4, warmup_steps=5, learning_rate=3e-3)


def foreseen_scene(index: int) -> LabelledScene:
    """Half a second later its first camera sees the same but for the car, its second brings nothing."""
    made = filmed_scene(index)
    return replace(made, next_frames=(NextFrame(made.scene.clips[0].camera, road(7000 + index)),))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    write_scenes(folder / "a.parquet", [foreseen_scene(index) for index in range(12)])
    return folder


@pytest.fixture(scope="module")
def codes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("codes")
    torch.manual_seed(0)
    VisualCodes(24).save(folder, {"steps": 7})
    return folder


def test_composing_is_learned_and_the_codes_stay(scenes: Path, codes: Path, tmp_path: Path) -> None:
    figures = train_composer(SHORT, scenes, codes, tmp_path, measured_pairs=2, validate_every=20)
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    measured = [row for row in rows if "composed_psnr_db" in row]
    assert [row["step"] for row in measured] == [20, 40]
    assert figures["composed_psnr_db"] == pytest.approx(measured[-1]["composed_psnr_db"])
    # Codes that say nothing paint nothing; most of the picture is the one of half a second before.
    assert figures["composed_psnr_db"] > figures["painted_psnr_db"] + 5
    before, after = load_visual_codes(codes), load_visual_codes(tmp_path)
    learned = after.state_dict()
    for name, value in before.state_dict().items():
        assert torch.equal(value, learned[name]), name
    assert after.details["steps"] == 7
    assert stages_of(after) == [(40, 10)]
    # Two rows of what was seen, what came, and what was made of it.
    with Image.open(tmp_path / SHEET_FILE) as sheet:
        assert sheet.size == (3 * 228 - 4, 2 * 116 - 4)


def stages_of(codes: VisualCodes) -> list[tuple[int, int]]:
    stages = codes.details["composer"]
    assert isinstance(stages, list)
    return [(stage["steps"], stage["pairs"]) for stage in stages]


def test_a_composer_learns_on(scenes: Path, codes: Path, tmp_path: Path) -> None:
    two_steps = replace(SHORT, steps=2, learning_rate=1e-9)
    for source, target in ((codes, "first"), (tmp_path / "first", "second")):
        train_composer(two_steps, scenes, source, tmp_path / target, measured_pairs=1)
    first, second = (load_visual_codes(tmp_path / name) for name in ("first", "second"))
    for name, value in first.state_dict().items():
        assert torch.allclose(value, second.state_dict()[name], atol=1e-6), name
    assert stages_of(second) == [(2, 10), (2, 10)]


@pytest.fixture(scope="module")
def imagining(codes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained checkpoint that imagines, with the codes."""
    folder = tmp_path_factory.mktemp("imagining") / "checkpoint"
    settings = VlaSettings(name="world", formats=("vla_world",), reflection="phrases")
    loaded = load(write_untrained(folder, narrow=True, settings=settings))
    parts = loaded.model, loaded.vocabulary, loaded.codec
    save(folder, *parts, details={"stages": [{"name": "sft"}]}, visual_codes=load_visual_codes(codes))
    return folder


def test_a_checkpoint_gets_a_composer_that_knows_what_it_writes(
    scenes: Path, imagining: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def counted(runner: Runner, requests: Sequence[PlanRequest]) -> dict[str, list[Draw]]:
        asked.extend(request.request_id for request in requests)
        return draws_of(runner, requests)

    monkeypatch.setattr(written_pictures, "draws_of", counted)
    short = replace(SHORT, steps=4)
    (tmp_path / LOG_FILE).write_text('{"stage": "1 sft", "step": 9}\n')
    figures = train_composer(short, scenes, imagining, tmp_path, written_pairs=3, measured_pairs=2)
    assert len(set(asked)) == len(asked) == 5
    learned, before = load(tmp_path), load(imagining)
    assert learned.card.revision != before.card.revision
    assert [stage["name"] for stage in learned.card.details["stages"]] == ["sft", "composer"]
    assert learned.card.details["stages"][1]["written_pairs"] == 3
    assert learned.visual_codes is not None
    assert learned.visual_codes.composer is not None
    assert figures["written_psnr_db"] > 0
    stages = [json.loads(line)["stage"] for line in (tmp_path / LOG_FILE).read_text().splitlines()]
    assert (stages[0], set(stages[1:])) == ("1 sft", {"2 composer"})
    # What was written once is read again, but for a line that a kill cut off.
    file = tmp_path / WRITTEN_FILE
    whole = file.read_text()
    file.write_text(whole[:-20])
    asked.clear()
    train_composer(short, scenes, imagining, tmp_path, written_pairs=3, measured_pairs=2)
    assert len(asked) == 1
    assert file.read_text() == whole
    with pytest.raises(ValueError, match="another checkpoint wrote"):
        train_composer(short, scenes, tmp_path, tmp_path, written_pairs=3, measured_pairs=2)


def test_pairs_are_of_cameras_that_show_both_moments() -> None:
    [pair] = pairs_of([foreseen_scene(3)])
    scene = foreseen_scene(3).scene
    assert (pair.scene_id, pair.camera) == (scene.scene_id, scene.clips[0].camera)
    assert pair.seen == scene.clips[0].images[-2:]
    moved, came = pair.frames()
    np.testing.assert_array_equal(came, frame_of(road(7003)))
    for one, seen in zip(moved, pair.seen, strict=True):
        assert (one != frame_of(seen)).any()


def test_pairs_are_mirrored_together_and_every_second_one_is_written() -> None:
    [pair] = pairs_of([foreseen_scene(0)])
    moved, came = pair.frames()
    codes = tuple(range(500, 598))
    kinds = Counter[tuple[bool, bool]]()
    for one, other, levels in map(PairDataset([replace(pair, written=codes)]).__getitem__, [0] * 60):
        plain = bool((one == moved).all() and (other == came).all())
        assert plain or ((one == moved[:, :, ::-1]).all() and (other == came[:, ::-1]).all())
        written = bool((levels >= 0).all())
        assert written or (levels == -1).all()
        if written:
            np.testing.assert_array_equal(codes_of(np.moveaxis(levels, 0, -1)).ravel(), codes)
        kinds[plain, written] += 1
    assert set(kinds) == {(True, False), (True, True), (False, False)}
    assert 15 < kinds[True, True] < 45
    assert (PairDataset([pair])[0].written == -1).all()


def test_spoilt_levels_are_levels() -> None:
    random = torch.Generator().manual_seed(0)
    most = torch.tensor(LEVELS)[:, None, None]
    levels, before = ((torch.rand(64, 4, 7, 14, generator=random) * most).floor() for _ in range(2))
    torch.manual_seed(0)
    spoilt = ComposerLearner._spoilt(levels, before)
    assert torch.equal(spoilt, spoilt.round())
    assert ((spoilt >= 0) & (spoilt < most)).all()
    wrong = (spoilt != levels).float().mean(dim=(1, 2, 3))
    assert wrong.min() < 0.1
    assert wrong.max() > 0.6


def test_composed_figures(codes: Path) -> None:
    composing = VisualCodes(24, composes=True)
    figures = composed_figures(composing, pairs_of([foreseen_scene(0), foreseen_scene(1)]))
    assert figures["measured_pairs"] == 2
    assert set(figures) == {"moved_psnr_db", "painted_psnr_db", "composed_psnr_db", "measured_pairs"}
    batch = collate_pairs([PairDataset(pairs_of([foreseen_scene(0)]))[0]])
    losses = ComposerLearner(composing)(**batch)
    losses["loss"].backward()
    learned = {name for name, value in composing.named_parameters() if value.grad is not None}
    assert {name.split(".")[0] for name in learned} == {"composer"}


def test_what_cannot_be_learned_from_is_refused(scenes: Path, codes: Path, tmp_path: Path) -> None:
    write_scenes(tmp_path / "plain.parquet", [filmed_scene(0)])
    with pytest.raises(ValueError, match="--next-frames"):
        train_composer(SHORT, tmp_path / "plain.parquet", codes, tmp_path / "to", scenes)


def test_the_command(scenes: Path, codes: Path, tmp_path: Path) -> None:
    asked = ["train", "composer", "--scenes", str(scenes), "--to", str(tmp_path / "codes")]
    refused = CliRunner().invoke(app, asked)
    assert refused.exit_code == 2
    assert "--from" in refused.output
    done = CliRunner().invoke(
        app, [*asked, "--from", str(codes), "--steps", "2", "--batch-size", "2"], catch_exceptions=False
    )
    assert done.exit_code == 0, done.output
    assert "composed_psnr_db " in done.output
    assert {path.name for path in (tmp_path / "codes").iterdir()} >= {
        "visual_codes.safetensors",
        "log.jsonl",
        "pictures.png",
        "curves.png",
    }
