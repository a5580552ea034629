from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from torch.utils.data import DataLoader, Dataset, Subset
from transformers import TrainerState

from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.training.recipes import NANO
from looktwice.model.training.run import run
from looktwice.model.training.run_settings import RunSettings
from looktwice.model.training.sampler import TaskSampler
from looktwice.model.training.trainer import _Epochs, draw_apart
from tests.model.training.scenes import training_scene

# torch warns where there are fewer cores than workers.
pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")


class _Chances(Dataset[float]):
    def __init__(self) -> None:
        self.random = np.random.default_rng(0)

    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> float:
        return float(self.random.random())


def test_workers_draw_numbers_of_their_own() -> None:
    loader = DataLoader(Subset(_Chances(), range(8)), batch_size=1, num_workers=2, worker_init_fn=draw_apart)
    drawn = [float(value) for value in loader]
    assert len(set(drawn)) == len(drawn)


def test_a_run_that_goes_on_takes_the_order_of_its_epoch() -> None:
    going_on, afresh = (TaskSampler(np.ones(64, np.bool_), 8, {"cf_vla": 1.0}, 0.5, seed=3) for _ in "ab")
    epochs = _Epochs(going_on)
    for told, epoch in ((0.0, 0), (2.37, 2), (3.0, 3), (3.9999999, 4)):
        epochs.on_epoch_begin(None, TrainerState(epoch=told), None)
        afresh.set_epoch(epoch)
        assert list(going_on) == list(afresh)


@pytest.mark.parametrize("recipe", ["ground", "read-tracks", "meta-act"])
def test_batches_are_prepared_in_other_processes(
    recipe: str, resampling_checkpoint: Path, tmp_path: Path
) -> None:
    write_scenes(tmp_path / "scenes" / "a.parquet", [training_scene(index) for index in range(8)])
    short = replace(NANO[recipe], steps=3, batch_size=4, warmup_steps=1)
    settings = RunSettings(tmp_path / "cache", bf16=False, workers=2)
    run(short, tmp_path / "scenes", resampling_checkpoint, tmp_path / "trained", settings)
    last = json.loads((tmp_path / "trained" / "log.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 3
    # transformers' trainer counts a loss that is no number as 0.
    assert np.isfinite(last["train_loss"])
    assert last["train_loss"] > 0
