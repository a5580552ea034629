"""Pictures are decoded once, beside the engine's thread."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from looktwice.model.driving.images import ImageError
from looktwice.model.driving.scene import Clip, Scene
from looktwice.model.engines.engine import Controls, DrawFinished, PlanRequest
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.engines.torch.picture_cache import Frames
from looktwice.model.network.checkpoint import load
from looktwice.model.network.inputs import InputBuilder
from tests.checkpoints import noisy_scene


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, bytes]]:
    """The thread that decoded, and what, picture by picture."""
    found: list[tuple[str, bytes]] = []
    decode = InputBuilder.frame

    def frame(self: InputBuilder, picture: bytes) -> npt.NDArray[np.uint8]:
        found.append((threading.current_thread().name, picture))
        return decode(self, picture)

    monkeypatch.setattr(InputBuilder, "frame", frame)
    return found


@pytest.fixture(scope="module")
def inputs(untrained_checkpoint: Path) -> InputBuilder:
    return load(untrained_checkpoint).inputs


def half_a_second_later(scene: Scene, new: Scene) -> Scene:
    """Its clips without their oldest pictures, and with the newest of another scene."""
    clips = [Clip(clip.camera, (*clip.images[1:], new.clip(clip.camera).images[-1])) for clip in scene.clips]
    return replace(scene, clips=tuple(clips))


def test_a_planners_next_request_decodes_what_is_new(
    inputs: InputBuilder, decoded: list[tuple[str, bytes]]
) -> None:
    frames, scene = Frames(inputs), noisy_scene()
    for shown in (scene, scene, half_a_second_later(scene, noisy_scene(1))):
        patches = [frames.patches(pictures) for pictures in inputs.slices(shown)]
        made = np.concatenate([inputs.patches(pictures) for pictures in inputs.slices(shown)])
        np.testing.assert_array_equal(np.concatenate(patches), made)
    pictures = sum(len(clip.images) for clip in scene.clips)
    assert len(decoded) == pictures + len(scene.clips) + 3 * pictures  # the last by `inputs` itself


def test_frames_are_bounded(inputs: InputBuilder, decoded: list[tuple[str, bytes]]) -> None:
    one = inputs.frame(noisy_scene().clips[0].images[0]).nbytes
    frames = Frames(inputs, max_bytes=3 * one)
    for seed in range(4):
        frames.look_at(noisy_scene(seed))
        assert len(frames) == 3
    before = len(decoded)
    frames.patches(noisy_scene(3).clips[-1].images[-2:])
    assert len(decoded) == before


def test_several_threads_may_look(inputs: InputBuilder) -> None:
    frames = Frames(inputs, max_bytes=20 * inputs.frame(noisy_scene().clips[0].images[0]).nbytes)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda number: frames.look_at(noisy_scene(number % 5)), range(40)))
    assert 0 < len(frames) <= 20


def test_the_engines_thread_decodes_nothing(
    untrained_checkpoint: Path, decoded: list[tuple[str, bytes]]
) -> None:
    async def test() -> None:
        engine = TorchEngine(untrained_checkpoint, TorchSettings(rows=8, products=None))
        await engine.start()
        try:
            decoded.clear()
            request = PlanRequest("later", noisy_scene(7), "traj_only", Controls(n=2))
            draws = [each async for each in engine.submit(request) if isinstance(each, DrawFinished)]
            assert len(draws) == 2
            # Engines of other tests may still be at theirs.
            shown = [picture for clip in request.scene.clips for picture in clip.images]
            threads = [name for name, picture in decoded if picture in shown]
            assert len(threads) == len(shown)
            assert not any("engine" in name for name in threads)

            clip = request.scene.clips[0]
            damaged = replace(clip, images=(*clip.images[:3], clip.images[3][:-200]))
            broken = replace(request.scene, clips=(damaged, *request.scene.clips[1:]))
            with pytest.raises(ImageError, match="damaged"):
                async for _ in engine.submit(PlanRequest("broken", broken, "traj_only", Controls(n=2))):
                    pass
        finally:
            await engine.stop()

    asyncio.run(asyncio.wait_for(test(), 120))
