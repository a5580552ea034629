from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from looktwice.model.evaluation.curves import training_curves


def log_of(path: Path, rows: list[object]) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def height(path: Path) -> int:
    with Image.open(path) as image:
        assert image.format == "PNG"
        return image.height


def test_losses_and_errors_share_a_picture(tmp_path: Path) -> None:
    losses = [{"step": step, "loss": 5 / step, "learning_rate": 1e-3} for step in range(1, 100)]
    errors = [{"step": step, "min_ade_m": 3 - step / 100, "note": "warm"} for step in (20, 40, 60)]
    training_curves(log_of(tmp_path / "both.jsonl", [*losses, *errors]), tmp_path / "both.png")
    training_curves(log_of(tmp_path / "one.jsonl", [*losses]), tmp_path / "one.png")
    assert height(tmp_path / "both.png") == 2 * height(tmp_path / "one.png")


def test_only_the_last_stage_is_drawn(tmp_path: Path) -> None:
    last = [{"stage": "2 b", "step": step, "loss": 1 / step} for step in (1, 2)]
    before = [{"stage": "1 a", "step": step, "min_ade_m": 3.0} for step in (1, 2)]
    training_curves(log_of(tmp_path / "all.jsonl", [*before, *last]), tmp_path / "all.png")
    training_curves(log_of(tmp_path / "last.jsonl", [*last]), tmp_path / "last.png")
    assert (tmp_path / "all.png").read_bytes() == (tmp_path / "last.png").read_bytes()


def test_a_log_without_figures_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="neither a loss nor a displacement error"):
        training_curves(log_of(tmp_path / "log.jsonl", [{"step": 1, "note": "x"}]), tmp_path / "x.png")
    with pytest.raises(ValueError, match="line 2 of the training log"):
        training_curves(log_of(tmp_path / "log.jsonl", [{"step": 1}, [1, 2]]), tmp_path / "x.png")
