"""What the tower made of pictures is kept for requests that show them again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from looktwice.model.driving.scene import Clip, Scene
from looktwice.model.engines.torch.clips import ClipCache
from looktwice.model.engines.torch.runner import PromptRequest, Runner
from looktwice.model.network.checkpoint import load
from tests.checkpoints import noisy_scene

SLICES = 4
"""Of a scene: two cameras, four pictures each, two of them a slice."""


def later(scene: Scene, pictures: int) -> Scene:
    """As many of its oldest pictures gone, and as many new ones."""
    new = noisy_scene(9)
    clips = [
        Clip(clip.camera, (*clip.images[pictures:], *new.clip(clip.camera).images[:pictures]))
        for clip in scene.clips
    ]
    return replace(scene, clips=tuple(clips))


@pytest.mark.parametrize(
    ("shown", "reuse", "encoded"),
    [
        (lambda scene: scene, True, 0),
        (lambda scene: replace(scene, history=noisy_scene(3).history), True, 0),
        (lambda scene: later(scene, 2), True, SLICES // 2),
        # Slices are pairs of pictures: moved on by one picture, every pair is another.
        (lambda scene: later(scene, 1), True, SLICES),
        (lambda scene: scene, False, SLICES),
    ],
    ids=["again", "elsewhere", "a second later", "half a second later", "told to forget"],
)
def test_pictures_seen_lately_are_not_encoded_again(
    untrained_checkpoint: Path, monkeypatch: pytest.MonkeyPatch, shown: Any, reuse: bool, encoded: int
) -> None:
    loaded = load(untrained_checkpoint)
    with torch.inference_mode():
        runner = Runner(loaded, 2, clip_bytes=1 << 24, reuse=reuse)
        scene = noisy_scene()
        runner.begin_prompts([PromptRequest(scene, "cf_vla", 0)])
        slices, vision = [], loaded.model.vision

        def looking(pixels: Any, grid: Any, *copies: Any) -> Any:
            slices.extend(grid)
            return vision(pixels, grid, *copies)

        monkeypatch.setattr(loaded.model, "vision", looking)
        runner.begin_prompts([PromptRequest(shown(scene), "cf_vla", 1)])
    assert len(slices) == encoded


def test_the_longest_unseen_is_forgotten_first() -> None:
    cache = ClipCache(2 * 4 * 10)
    for key in (b"a", b"b"):
        cache.keep(key, torch.zeros(10))
    assert cache.get(b"a") is not None
    cache.keep(b"c", torch.zeros(10))
    assert [cache.get(key) is not None for key in (b"a", b"b", b"c")] == [True, False, True]
    cache.keep(b"larger than all", torch.zeros(21))
    assert cache.get(b"larger than all") is None
    assert len(cache) == 2
