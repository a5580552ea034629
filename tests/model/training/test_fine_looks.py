"""Convolutions learn to find who is in view, beside a tower that stays as it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.perceived import Perceived, PerceivedAgent
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.network.checkpoint import Loaded, load, with_fine_vision
from looktwice.model.network.fine_vision import STRIDE
from looktwice.model.network.vla_settings import NANO_SETTINGS
from looktwice.model.training.batches import stacked
from looktwice.model.training.examples import Examples
from looktwice.model.training.fact_reading import FactDataset
from looktwice.model.training.fine_looks import UNKNOWN, FineDataset, FineLearner, FineSample, marked
from looktwice.model.training.recipes import NANO
from looktwice.model.training.run import RunSettings, run
from looktwice.model.training.vision_cache import open_vision
from tests.model.training.scenes import training_scene

SCENES = [training_scene(index) for index in range(8)]
SETTINGS = replace(NANO_SETTINGS, fine_vision=True)
SOMEBODY = Perceived((PerceivedAgent("pedestrian", 30.0, 4.0, 0.6, 0.6, None),), 2.0, 2.0)


@pytest.fixture(scope="module")
def fine(resampling_checkpoint: Path) -> Loaded:
    return with_fine_vision(load(resampling_checkpoint))


@pytest.fixture(scope="module")
def looks(fine: Loaded, tmp_path_factory: pytest.TempPathFactory) -> FineDataset:
    examples = Examples.from_scenes(SCENES, (FRONT_WIDE, FRONT_TELE))
    folder = tmp_path_factory.mktemp("vision")
    vision = open_vision(fine, examples, folder, mirrored=True, fine=False)
    assert vision.tokens(0, False).shape[0] == 2 * fine.settings.clip_tokens
    return FineDataset(FactDataset(examples, vision, route_share=1.0), examples, fine.inputs)


@pytest.mark.parametrize("mirror", [False, True])
def test_who_is_in_view_is_marked_where_each_camera_shows_them(mirror: bool) -> None:
    marks, away_log, shift = marked(SOMEBODY, SETTINGS, mirror=mirror)
    assert marks.shape == (2, 3, 11, 21)
    assert marks.sum() == 2, "once in each picture"
    for place, camera in enumerate(SETTINGS.cameras):
        [[kind, row, column]] = np.argwhere(marks[place])
        assert kind == 0
        spec = CAMERA_SPECS[camera].resized(336)
        beside_m = -4.0 if mirror else 4.0
        x, y, away_m = spec.project(np.array([[30.0, beside_m, 0.9]]))[0]
        assert STRIDE * (column + 0.5 + shift[place, row, column]) == pytest.approx(x, abs=1e-3)
        assert abs(shift[place, row, column]) <= 0.5
        assert abs(STRIDE * (row + 0.5) - y) <= STRIDE / 2
        assert np.expm1(away_log[place, row, column]) == pytest.approx(away_m, rel=1e-4)
    assert np.count_nonzero(away_log) == 2


def test_who_is_beside_or_behind_the_pictures_is_not_marked() -> None:
    agents = tuple(
        PerceivedAgent("vehicle", x_m, y_m, 4.5, 1.8, None) for x_m, y_m in ((2.0, 20.0), (-9.0, 0.0))
    )
    assert not marked(Perceived(agents, 2.0, 2.0), SETTINGS, mirror=False)[0].any()
    assert (marked(None, SETTINGS, mirror=False)[0] == UNKNOWN).all()


def test_a_scene_comes_with_its_last_two_pictures(looks: FineDataset, fine: Loaded) -> None:
    sample = looks[3]
    settings = fine.settings
    assert sample.pictures.shape == (2, 2, 3, settings.image_height, settings.image_width)
    assert sample.tokens.shape == (2 * settings.clip_tokens, 256)


def test_what_is_small_is_found_after_a_few_steps(looks: FineDataset, resampling_checkpoint: Path) -> None:
    torch.manual_seed(0)
    learner = FineLearner(with_fine_vision(load(resampling_checkpoint)).model).train()
    samples = [looks[place] for place in range(len(looks))]
    # Somebody walks where the picture is white.
    samples = [_with_somebody(each, place % 2 == 0) for place, each in enumerate(samples)]
    batch = stacked(samples)
    optimizer = torch.optim.AdamW([each for each in learner.parameters() if each.requires_grad], 3e-3)
    first = learner(**batch)
    for _ in range(25):
        optimizer.zero_grad()
        learner(**batch)["loss"].backward()
        optimizer.step()
    last = learner(**batch)
    assert last["find_loss"] < 0.5 * first["find_loss"]
    assert last["fact_loss"] < first["fact_loss"]


def _with_somebody(sample: FineSample, there: bool) -> FineSample:
    found = marked(SOMEBODY if there else Perceived((), 2.0, 2.0), SETTINGS, mirror=False)
    pictures = sample.pictures // 4
    for place in range(2 if there else 0):
        [[_, row, column]] = np.argwhere(found[0][place])
        pictures[place, 1, :, row * STRIDE : (row + 1) * STRIDE, column * STRIDE : (column + 1) * STRIDE] = (
            255
        )
    return sample._replace(marks=found[0], away_log=found[1], shift=found[2], pictures=pictures)


def test_the_stage_adds_convolutions_and_leaves_the_tower(
    resampling_checkpoint: Path, tmp_path: Path
) -> None:
    write_scenes(tmp_path / "scenes" / "a.parquet", SCENES)
    settings = RunSettings(tmp_path / "cache", save_every=2, bf16=False)
    recipe = replace(NANO["fine-vision"], steps=2, batch_size=4, warmup_steps=1, learning_rate=1e-2)
    run(recipe, tmp_path / "scenes", resampling_checkpoint, tmp_path / "done", settings)
    more = replace(recipe, seed=1)
    run(more, tmp_path / "scenes", tmp_path / "done", tmp_path / "more", settings)
    before = load(resampling_checkpoint).model.bfloat16().state_dict()
    done, again = (
        load(tmp_path / name, dtype=torch.bfloat16).model.state_dict() for name in ("done", "more")
    )
    for old, new in ((before, done), (done, again)):
        moved = {name for name, value in new.items() if name not in old or not value.equal(old[name])}
        assert {name.split(".")[0] for name in moved} == {"fine_vision", "resampler"}
        of_resampler = {name.split(".")[1] for name in moved if name.startswith("resampler.")}
        assert of_resampler == {"spotted", "fine_layer", "facts"}
    assert load(tmp_path / "more").settings.fine_vision
