from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from looktwice.model.driving.facts import IS_YES_OR_NO, mirrored
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, NO_PICTURE
from looktwice.model.network.card import weights_revision
from looktwice.model.network.checkpoint import Loaded, load, save
from looktwice.model.network.intent import INTENT_TOKENS
from looktwice.model.network.small_planner import WEIGHTS_FILE, SmallPlannerError, load_small, small_revision
from looktwice.model.network.track_features import TRACK_FEATURES
from looktwice.model.network.vla import LookTwiceVla, with_settings
from looktwice.model.training.batches import stacked
from looktwice.model.training.examples import Examples
from looktwice.model.training.intents import (
    IntentDataset,
    IntentLearner,
    Source,
    read_errors,
    read_facts,
)
from looktwice.model.training.vision_cache import open_vision
from tests.model.training.scenes import training_scene

SCENES = [training_scene(index) for index in range(6)]
ON_ROUTE = TRACK_FEATURES.index("on_route")


@pytest.fixture(scope="module")
def loaded(resampling_checkpoint: Path) -> Loaded:
    return load(resampling_checkpoint)


@pytest.fixture(scope="module")
def examples() -> Examples:
    return Examples.from_scenes(SCENES, (FRONT_WIDE, FRONT_TELE))


@pytest.fixture(scope="module")
def data(loaded: Loaded, examples: Examples, tmp_path_factory: pytest.TempPathFactory) -> IntentDataset:
    vision = open_vision(loaded, examples, tmp_path_factory.mktemp("vision"), mirrored=True)
    return IntentDataset(examples, read_facts(loaded.model, examples, vision), route_share=1.0)


def test_a_mirrored_look_swaps_everything_it_knows(data: IntentDataset, examples: Examples) -> None:
    plain, swapped = (data.look(1, mirror=mirror, route=True) for mirror in (False, True))
    np.testing.assert_array_equal(swapped.history[:, 1], -plain.history[:, 1])
    np.testing.assert_array_equal(swapped.futures[:, [1, 3]], -plain.futures[:, [1, 3]])
    np.testing.assert_array_equal(swapped.route[:, 1], -plain.route[:, 1])
    np.testing.assert_array_equal(swapped.facts, mirrored(plain.facts))
    np.testing.assert_array_equal(swapped.plan_bins, examples.plan(1).mirrored().bins())
    assert not np.array_equal(swapped.read, plain.read)


def test_scenes_without_pictures_are_misread_like_those_with(loaded: Loaded, tmp_path: Path) -> None:
    blind = []
    for labelled in SCENES[1:3]:
        clips = tuple(replace(clip, images=(NO_PICTURE,) * 4) for clip in labelled.scene.clips)
        blind.append(replace(labelled, scene=replace(labelled.scene, clips=clips)))
    examples = Examples.from_scenes([*SCENES, *blind], (FRONT_WIDE, FRONT_TELE))
    vision = open_vision(loaded, examples, tmp_path, mirrored=True)
    read = read_facts(loaded.model, examples, vision)
    assert np.isfinite(read).all()
    assert ((read[..., IS_YES_OR_NO] >= 0) & (read[..., IS_YES_OR_NO] <= 1)).all()
    assert not np.array_equal(read[6, 0, 1], np.nan_to_num(examples.facts[6])), "nothing was misread"
    again = read_facts(loaded.model, examples, vision)
    np.testing.assert_array_equal(read, again)


def test_readings_may_be_trusted(loaded: Loaded, tmp_path: Path) -> None:
    blind = []
    for labelled in SCENES:
        clips = tuple(replace(clip, images=(NO_PICTURE,) * 4) for clip in labelled.scene.clips)
        blind.append(replace(labelled, scene=replace(labelled.scene, clips=clips)))
    examples = Examples.from_scenes([*SCENES, *blind], (FRONT_WIDE, FRONT_TELE))
    vision = open_vision(loaded, examples, tmp_path, mirrored=True)
    misread, half, true = (
        read_facts(loaded.model, examples, vision, misread_share=share) for share in (1.0, 0.5, 0.0)
    )
    np.testing.assert_array_equal(true[: len(SCENES)], misread[: len(SCENES)])
    for place in range(len(SCENES), len(examples)):
        for route in range(2):
            np.testing.assert_array_equal(true[place, 0, route], examples.facts[place])
            np.testing.assert_array_equal(true[place, 1, route], mirrored(examples.facts[place]))
    kept = [np.array_equal(one, other, equal_nan=True) for one, other in zip(half, true, strict=True)]
    assert 0 < sum(kept[len(SCENES) :]) < len(blind)
    # A fact that does not apply says nothing; it must not reach the network as NaN.
    learner = IntentLearner(loaded.model, loaded.codec, "scene").eval()
    data = IntentDataset(examples, true, route_share=1.0)
    batch = stacked([data.look(place, mirror=False, route=True) for place in range(len(data))])
    with torch.inference_mode():
        assert torch.isfinite(learner(**batch)["loss"])


def test_tracks_tell_nothing_of_a_route_that_is_not_given(data: IntentDataset) -> None:
    given, kept_back = (data.look(1, mirror=False, route=route) for route in (True, False))
    assert given.has_route
    assert not kept_back.has_route
    assert given.tracks[:, ON_ROUTE].any()
    assert not kept_back.tracks[:, ON_ROUTE].any()


@pytest.mark.parametrize("source", ["tracks", "scene"])
def test_a_few_steps_learn_to_plan_from_a_source_and_leave_the_rest_alone(
    resampling_checkpoint: Path, data: IntentDataset, source: Source
) -> None:
    loaded = load(resampling_checkpoint)
    before = {name: value.clone() for name, value in loaded.model.state_dict().items()}
    torch.manual_seed(0)
    learner = IntentLearner(loaded.model, loaded.codec, source).train()
    optimizer = torch.optim.AdamW(learner.parameters(), 3e-3)
    batch = stacked([data.look(index, mirror=False, route=True) for index in range(len(data))])
    losses = []
    for _ in range(40):
        outputs = learner(**batch)
        optimizer.zero_grad()
        outputs["loss"].backward()
        optimizer.step()
        losses.append({name: float(value.detach()) for name, value in outputs.items()})
    assert losses[-1]["plan_ade_m"] < 0.6 * losses[0]["plan_ade_m"]
    assert losses[-1]["word_loss"] < 0.6 * losses[0]["word_loss"]
    changed = {name for name, value in loaded.model.state_dict().items() if not value.equal(before[name])}
    learned = "track_reader." if source == "tracks" else "resampler.intent."
    assert changed
    assert all(name.startswith(learned) for name in changed)


def test_held_out_scenes_are_read_with_and_without_their_route(
    resampling_checkpoint: Path, examples: Examples, data: IntentDataset
) -> None:
    loaded = load(resampling_checkpoint)
    learner = IntentLearner(loaded.model, loaded.codec, "tracks").train()
    figures = read_errors(learner, examples, None)
    assert learner.training
    one_by_one = []
    learner.eval()
    for index in range(len(data)):
        batch = stacked([data.look(index, mirror=False, route=True)])
        with torch.inference_mode():
            one_by_one.append(float(learner(**batch)["plan_ade_m"]))
    assert figures["plan_ade_m/read+route"] == pytest.approx(np.mean(one_by_one), rel=1e-4)
    assert figures["fact_loss/read"] != figures["fact_loss/read+route"]


def test_a_checkpoint_without_the_source_is_refused(untrained_checkpoint: Path) -> None:
    loaded = load(untrained_checkpoint)
    with pytest.raises(ValueError, match="reads no tracks"):
        IntentLearner(loaded.model, loaded.codec, "tracks")


def test_readers_of_tracks_ignore_order_and_rows_of_nobody(loaded: Loaded, data: IntentDataset) -> None:
    reader = loaded.model.track_reader
    assert reader is not None
    sample = data.look(1, mirror=False, route=True)
    history, route, tracks = (
        torch.from_numpy(part)[None] for part in (sample.history, sample.route, sample.tracks)
    )
    way = (history, route, torch.ones(1, dtype=torch.bool))
    with torch.inference_mode():
        tokens = reader(tracks, *way)
        turned = reader(tracks.flip(1), *way)
        nobody = reader(torch.zeros_like(tracks), *way)
        none = reader(tracks[:0], *(part[:0] for part in way))
    assert tokens.shape[1] == INTENT_TOKENS
    assert none.shape == (0, *tokens.shape[1:])
    torch.testing.assert_close(turned, tokens)
    assert not torch.allclose(nobody, tokens)


def test_a_reader_of_tracks_with_sketches_is_a_small_planner(
    resampling_checkpoint: Path, data: IntentDataset, tmp_path: Path
) -> None:
    loaded = load(resampling_checkpoint)
    learner = IntentLearner(loaded.model, loaded.codec, "tracks").eval()
    planner = load_small(resampling_checkpoint)
    assert planner.kind == "teacher"
    sample = data.look(1, mirror=False, route=True)
    batch = stacked([sample])
    with torch.inference_mode():
        trajectory = planner.plan([SCENES[1].given(route=True, tracks=True)])
        off_m = np.linalg.norm(trajectory[0, :, :2] - sample.futures[:, :2], axis=1).mean()
        assert off_m == pytest.approx(float(learner(**batch)["plan_ade_m"]), rel=1e-4)
    assert small_revision(resampling_checkpoint) == weights_revision(resampling_checkpoint)
    config = with_settings(loaded.model.config, replace(loaded.settings, sketch_tokens=0), loaded.vocabulary)
    save(tmp_path, LookTwiceVla(config), loaded.vocabulary, loaded.codec)
    with pytest.raises(SmallPlannerError, match="sketches nothing"):
        load_small(tmp_path)


def test_folders_of_no_small_planner_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SmallPlannerError, match="has no planner"):
        load_small(tmp_path)
    (tmp_path / WEIGHTS_FILE).write_bytes(b"none")
    with pytest.raises(SmallPlannerError, match="is damaged"):
        load_small(tmp_path)
    for about, told in (
        ({"version": 1, "kind": "teacher"}, "has version 1; this LookTwice reads 2"),
        ({"version": 2, "kind": "facts"}, "is a planner of facts, which drives nowhere"),
    ):
        weights = {"weight": torch.zeros(1)}
        save_file(weights, tmp_path / WEIGHTS_FILE, metadata={"looktwice": json.dumps(about)})
        with pytest.raises(SmallPlannerError, match=told):
            load_small(tmp_path)
