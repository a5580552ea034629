"""Convolutions learn to find who is in view, beside a tower that stays as it is."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.perceived import Perceived, PerceivedAgent
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.driving.tracks import Track
from looktwice.model.driving.trajectory import POSE_MIRROR
from looktwice.model.network.checkpoint import Loaded, load, with_fine_vision
from looktwice.model.network.fine_vision import STRIDE, TOLD
from looktwice.model.network.resampler import PICTURE_BEFORE, placed
from looktwice.model.network.track_features import track_features
from looktwice.model.network.vla_settings import NANO_SETTINGS
from looktwice.model.training.batches import stacked
from looktwice.model.training.examples import Examples
from looktwice.model.training.fact_reading import FactDataset
from looktwice.model.training.fine_looks import (
    UNKNOWN,
    FineDataset,
    FineLearner,
    FineSample,
    faces_of,
    marked,
)
from looktwice.model.training.recipes import NANO
from looktwice.model.training.run import run
from looktwice.model.training.run_settings import RunSettings
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
    faces = np.array([[0.3, 32.0, 5.5]], np.float32)
    found = marked(SOMEBODY, faces, SETTINGS, mirror=mirror)
    assert found.marks.shape == (2, 3, 11, 21)
    assert found.marks.sum() == 2, "once in each picture"
    side = -1 if mirror else 1
    for place, camera in enumerate(SETTINGS.cameras):
        [[kind, row, column]] = np.argwhere(found.marks[place])
        assert kind == 0
        spec = CAMERA_SPECS[camera].resized(336)
        (x, y, away_m), (x_before, _, _) = spec.project(
            np.array([[29.7, 4.0 * side, 0.9], [31.7, 5.5 * side, 0.9]])
        )
        at = place, row, column
        assert STRIDE * (column + 0.5 + found.shift[at]) == pytest.approx(x, abs=1e-3)
        assert abs(found.shift[at]) <= 0.5
        assert abs(STRIDE * (row + 0.5) - y) <= STRIDE / 2
        assert np.expm1(found.away_log[at]) == pytest.approx(away_m, rel=1e-4)
        assert STRIDE * np.exp(found.half_log[at]) == pytest.approx(spec.focal_px * 0.24 / away_m, rel=1e-4)
        assert STRIDE * found.came[place, 1, row, column] == pytest.approx(x_before - x, abs=1e-3)
    assert np.count_nonzero(found.away_log) == 2
    assert np.isfinite(found.came).sum() == 6


@given(
    st.floats(6, 40),
    st.floats(-8, 8),
    st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi]),
    st.floats(0, 9),
    st.floats(0, 6),
    st.floats(-0.15, 0.15),
    st.booleans(),
)
def test_how_somebody_moves_is_read_from_where_they_came_from(
    x_m: float, y_m: float, heading_rad: float, speed_ms: float, ego_m: float, ego_yaw: float, mirror: bool
) -> None:
    """A car drives somewhere while the ego drives and turns: what is marked gives back how fast."""
    car = Track(x_m, y_m, heading_rad, speed_ms, 4.0, 2.0, "vehicle")
    perceived = Perceived((PerceivedAgent("vehicle", x_m, y_m, 4.0, 2.0, None),), 2.0, 2.0)
    history = np.zeros((16, 4), np.float32)
    history[PICTURE_BEFORE] = -ego_m, 0.1 * ego_m, 0.0, ego_yaw
    found = marked(
        perceived, faces_of(perceived, track_features([car], None), history), SETTINGS, mirror=mirror
    )
    ego = torch.from_numpy(history * POSE_MIRROR if mirror else history)[None, None, PICTURE_BEFORE]
    half_deep_m = 2.0 if math.sin(heading_rad) ** 2 < 0.5 else 1.0
    for place, camera in enumerate(SETTINGS.cameras):
        for _, row, column in np.argwhere(found.marks[place]):
            at = place, row, column
            left, middle, right = found.came[place, :, row, column].tolist()
            if not math.isfinite(left + middle + right):
                continue
            half = math.exp(found.half_log[at])
            told = {
                "likely": 1.0,
                "away_log": float(found.away_log[at]),
                "across": 2 * (column + 0.5 + float(found.shift[at])) / 21 - 1,
                "came": 2 * middle / 21,
                "sure": 1.0,
                "nearer_log": float(found.nearer_log[at]),
            }
            grown = half / (half + (right - left) / 2)
            assert told["nearer_log"] == pytest.approx(math.log(grown), abs=1e-3)
            row_told = torch.tensor([[[told.get(name, 0.0) for name in TOLD]]])
            who = placed(CAMERA_SPECS[camera].resized(336), row_told, ego)
            side = -1 if mirror else 1
            assert who.ahead_m.item() == pytest.approx(x_m - half_deep_m, abs=0.05)
            assert who.left_m.item() == pytest.approx(
                side * y_m * (x_m - half_deep_m - 1.2) / (x_m - 1.2), abs=9
            )
            speeds = side * speed_ms * math.sin(heading_rad), speed_ms * math.cos(heading_rad)
            # An object turns with the ego between the two pictures; a small angle is left out.
            slack = 0.05 + 10 * abs(ego_yaw)
            assert who.ahead_ms.item() == pytest.approx(speeds[1], abs=slack)
            if abs(speeds[1]) < 0.1:
                pixel_ms = (x_m - half_deep_m - 1.2) / CAMERA_SPECS[camera].resized(336).focal_px / 0.5
                told_ms = speeds[0] / (1 + (pixel_ms / 0.5) ** 2)
                assert who.left_ms.item() == pytest.approx(told_ms, abs=slack)


def test_who_is_not_tracked_came_from_nobody_knows_where() -> None:
    faces = faces_of(SOMEBODY, track_features([], None), np.zeros((16, 4), np.float32))
    assert faces[0, 0] == pytest.approx(0.3)
    found = marked(SOMEBODY, faces, SETTINGS, mirror=False)
    assert found.marks.any()
    assert np.isnan(found.came).all()


def test_of_two_at_one_place_the_nearer_one_is_told() -> None:
    agents = tuple(PerceivedAgent("vehicle", x_m, 0.1, 4.0, 2.0, None) for x_m in (30.0, 31.0))
    found = marked(Perceived(agents, 2.0, 2.0), np.full((2, 3), 2.0, np.float32), SETTINGS, mirror=False)
    assert np.expm1(found.away_log.max()) == pytest.approx(26.8, abs=0.01)


def test_who_is_beside_or_behind_the_pictures_is_not_marked() -> None:
    agents = tuple(
        PerceivedAgent("vehicle", x_m, y_m, 4.5, 1.8, None) for x_m, y_m in ((2.0, 20.0), (-9.0, 0.0))
    )
    faces = np.full((2, 3), np.nan, np.float32)
    assert not marked(Perceived(agents, 2.0, 2.0), faces, SETTINGS, mirror=False).marks.any()
    assert (marked(None, faces[:0], SETTINGS, mirror=False).marks == UNKNOWN).all()


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
    perceived = SOMEBODY if there else Perceived((), 2.0, 2.0)
    faces = np.full((len(perceived.agents), 3), 0.3, np.float32)
    found = marked(perceived, faces, SETTINGS, mirror=False)
    pictures = sample.pictures // 4
    for place in range(2 if there else 0):
        [[_, row, column]] = np.argwhere(found.marks[place])
        pictures[place, 1, :, row * STRIDE : (row + 1) * STRIDE, column * STRIDE : (column + 1) * STRIDE] = (
            255
        )
    return sample._replace(pictures=pictures, **found._asdict())


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
        assert of_resampler == {"spotted", "people_layers", "fine_layer", "facts"}
    assert load(tmp_path / "more").settings.fine_vision
