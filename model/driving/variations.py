"""Scenes that nobody has seen before: what caches of any engine cannot know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from looktwice.model.driving.images import decode_image, encode_jpeg
from looktwice.model.driving.scene import Clip, Scene


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


def moved(scene: Scene, steps: int) -> Scene:
    """``scene`` so many tenths of a second later, by its ego history: driven on at its speed and yaw rate.

    Pictures stay, as cameras are slower than planners.
    """
    history = scene.history.astype(np.float64)
    for _ in range(steps):
        dx, dy, dz, turn = history[-1] - history[-2]
        cosine, sine = np.cos(turn), np.sin(turn)
        # The last step, once more, from the present pose: turned as far as the ego turns in it.
        new = np.array([dx * cosine - dy * sine, dx * sine + dy * cosine, dz, turn])
        history = np.concatenate([history[1:], new[None]])
        # Seen from the new pose.
        x, y = history[:, 0] - new[0], history[:, 1] - new[1]
        history[:, 0] = x * cosine + y * sine
        history[:, 1] = -x * sine + y * cosine
        history[:, 2:] -= new[2:]
    return replace(scene, history=history.astype(np.float32))


def _coloured(image: bytes, colour: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> bytes:
    picture = decode_image(image).copy()
    picture[:8, :8] = colour
    return encode_jpeg(picture)
