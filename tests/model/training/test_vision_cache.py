from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, NO_PICTURE
from looktwice.model.families.cf_vla.targets import PAPER_WEIGHTS
from looktwice.model.network.checkpoint import Loaded, load, with_fine_vision
from looktwice.model.network.patches import patchify
from looktwice.model.training.batches import collate
from looktwice.model.training.examples import Examples, example_frames
from looktwice.model.training.learner import ResponseLearner
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.sampler import Item
from looktwice.model.training.vision_cache import VisionCache, open_vision
from tests.model.training.scenes import training_scene

CAMERAS = (FRONT_WIDE, FRONT_TELE)
EXAMPLES = replace(
    Examples.from_scenes((training_scene(k) for k in range(20)), CAMERAS), episode=np.repeat(np.arange(4), 5)
)
OTHERS = replace(
    Examples.from_scenes((training_scene(k) for k in range(20, 23)), CAMERAS), episode=np.full(3, 9)
)


@pytest.fixture(scope="module")
def loaded(resampling_checkpoint: Path) -> Loaded:
    return load(resampling_checkpoint)


def seen_now(loaded: Loaded, index: int, mirror: bool) -> torch.Tensor:
    settings = loaded.settings
    patches = patchify(example_frames(EXAMPLES, index, mirror, loaded.inputs), settings)
    with torch.inference_mode():
        return loaded.model.vision(torch.from_numpy(patches), torch.tensor([settings.grid] * 2))


def test_the_cache_holds_what_the_tower_sees(loaded: Loaded, tmp_path: Path) -> None:
    cache = open_vision(loaded, EXAMPLES, tmp_path, mirrored=True)
    for index, mirror in ((0, False), (3, True), (19, True)):
        kept = torch.from_numpy(cache.tokens(index, mirror).astype(np.float32))
        # Kept in float16.
        torch.testing.assert_close(kept, seen_now(loaded, index, mirror), rtol=0.1, atol=0.05)


@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # where there are fewer cores
def test_other_processes_decode_the_same(loaded: Loaded, tmp_path: Path) -> None:
    here = open_vision(loaded, EXAMPLES, tmp_path / "here", mirrored=True)
    there = open_vision(loaded, EXAMPLES, tmp_path / "there", mirrored=True, workers=2)
    for index in range(len(EXAMPLES)):
        for mirror in (False, True):
            np.testing.assert_array_equal(there.tokens(index, mirror), here.tokens(index, mirror))


def test_examples_without_pictures_have_no_tokens(loaded: Loaded, tmp_path: Path) -> None:
    blind = []
    for index in range(2):
        scene = training_scene(index)
        clips = tuple(replace(clip, images=(NO_PICTURE,) * 4) for clip in scene.scene.clips)
        blind.append(replace(scene, scene=replace(scene.scene, clips=clips)))
    without = replace(Examples.from_scenes(blind, CAMERAS), episode=np.full(2, 9))
    both = open_vision(loaded, Examples.concatenate([without, OTHERS]), tmp_path, mirrored=True)
    assert both.tokens(1, True).size == 0
    alone = open_vision(loaded, OTHERS, tmp_path, mirrored=True)
    for index in range(3):
        np.testing.assert_array_equal(both.tokens(2 + index, True), alone.tokens(index, True))


def test_a_killed_cache_goes_on_where_it_was(loaded: Loaded, tmp_path: Path) -> None:
    done: list[int] = []

    def killed(so_far: int, total: int) -> None:
        done.append(so_far)
        if so_far == 2:
            raise KeyboardInterrupt

    def open_examples(examples: Examples) -> VisionCache:
        return open_vision(
            loaded, examples, tmp_path, mirrored=False, on_done=lambda so_far, total: done.append(so_far)
        )

    with pytest.raises(KeyboardInterrupt):
        open_vision(loaded, EXAMPLES, tmp_path, mirrored=False, on_done=killed)
    whole = open_examples(EXAMPLES)
    assert done == [1, 2, 3, 4], "an episode that is there is not worked out again"
    more = Examples.concatenate([OTHERS, EXAMPLES])
    joined = open_examples(more)
    assert done == [1, 2, 3, 4, 5], "others that are added cost what they add"
    for index in range(len(EXAMPLES)):
        np.testing.assert_array_equal(joined.tokens(len(OTHERS) + index, False), whole.tokens(index, False))


def test_another_tower_has_another_cache(loaded: Loaded, resampling_checkpoint: Path, tmp_path: Path) -> None:
    other = load(resampling_checkpoint)
    with torch.no_grad():
        other.model.model.visual.merger.mlp[0].weight.add_(0.1)
    first = open_vision(loaded, EXAMPLES, tmp_path, mirrored=False)
    second = open_vision(other, EXAMPLES, tmp_path, mirrored=False)
    assert not np.array_equal(first.tokens(0, False), second.tokens(0, False))


def test_mixed_precision_has_a_cache_of_its_own(loaded: Loaded, tmp_path: Path) -> None:
    exact = open_vision(loaded, OTHERS, tmp_path, mirrored=False).tokens(0, False)
    mixed = open_vision(loaded, OTHERS, tmp_path, mirrored=False, bf16=True).tokens(0, False)
    assert not np.array_equal(exact, mixed)


def test_convolutions_beside_the_tower_have_files_of_their_own(loaded: Loaded, tmp_path: Path) -> None:
    first, second = (with_fine_vision(loaded, seed=seed) for seed in range(2))
    open_vision(loaded, EXAMPLES, tmp_path, mirrored=False)
    of_tower = set(tmp_path.iterdir())
    caches = [open_vision(each, EXAMPLES, tmp_path, mirrored=False) for each in (first, second)]
    assert len(set(tmp_path.iterdir()) - of_tower) == 2 * len(of_tower), (
        "the tower's are not worked out again"
    )
    for cache, checkpoint in zip(caches, (first, second), strict=True):
        expected = seen_now(checkpoint, 1, False).numpy()
        np.testing.assert_allclose(cache.tokens(1, False), expected, atol=2e-3, rtol=2e-3)
    tower_alone = open_vision(first, EXAMPLES, tmp_path, mirrored=False, fine=False)
    assert len(tower_alone.tokens(1, False)) == 2 * loaded.settings.clip_tokens


def test_other_pictures_under_the_same_names_have_another_cache(loaded: Loaded, tmp_path: Path) -> None:
    other = replace(EXAMPLES, picture_spans=np.roll(EXAMPLES.picture_spans, 1, axis=0))
    assert other.scene_id.tolist() == EXAMPLES.scene_id.tolist()
    first = open_vision(loaded, EXAMPLES, tmp_path, mirrored=False)
    second = open_vision(loaded, other, tmp_path, mirrored=False)
    np.testing.assert_array_equal(second.tokens(1, False), first.tokens(0, False))


def test_mirror_images_that_nobody_asked_for_are_not_there(loaded: Loaded, tmp_path: Path) -> None:
    cache = open_vision(loaded, EXAMPLES, tmp_path, mirrored=False)
    assert not cache.mirrored
    with pytest.raises(IndexError):
        cache.tokens(0, True)


def test_learning_from_the_cache_is_learning_from_the_pictures(loaded: Loaded) -> None:
    tokens = np.stack([seen_now(loaded, index, False).numpy() for index in range(2)])[None]

    def loss(vision: VisionCache | None) -> float:
        data = ResponseDataset(
            EXAMPLES,
            loaded.codec,
            loaded.inputs,
            loaded.vocabulary,
            PAPER_WEIGHTS,
            pictures=True,
            vision=vision,
        )
        items = [Item(0, "cf_vla", False, tracks=True), Item(1, "cf_vla", False, tracks=True)]
        torch.manual_seed(0)
        learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec, head_weight=0.5)
        with torch.no_grad():
            return float(learner(**collate([data[item] for item in items]))["loss"])

    assert loss(VisionCache([[tokens.astype(np.float16)]], cameras=2)) == pytest.approx(loss(None), rel=1e-3)
