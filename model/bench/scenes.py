"""Scenes that nobody has seen before: what caches of any engine cannot know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from model.driving.images import decode_image, encode_jpeg
from model.driving.scene import Clip, Scene


def fresh(scene: Scene, number: int) -> Scene:
    """``scene`` with a block of every picture coloured by ``number``: as hard, but new to every cache."""
    colour = np.random.default_rng(number).integers(0, 256, 3, np.uint8)
    return replace(
        scene,
        scene_id=f"{scene.scene_id}-{number}",
        clips=tuple(
            Clip(clip.camera, tuple(_coloured(image, colour) for image in clip.images))
            for clip in scene.clips
        ),
    )


def _coloured(image: bytes, colour: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> bytes:
    picture = decode_image(image).copy()
    picture[:8, :8] = colour
    return encode_jpeg(picture)
