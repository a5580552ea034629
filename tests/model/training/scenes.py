"""Labelled scenes with dense targets, as training wants them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, DenseTarget, LabelledScene
from tests.model.driving.drives import agent, labelled_scene


def training_scene(index: int) -> LabelledScene:
    """Slower or faster, with or without a car ahead, one in three without a route."""
    random = np.random.default_rng(index)
    scene = labelled_scene(
        speed=float(random.uniform(0, 20)),
        scene_id=f"scene-{index}",
        episode_id=f"episode-{index // 4}",
        agents=(agent(10.0 + index, 0.0),) if index % 2 else (),
        pictures=index,
    )
    dense = tuple(
        DenseTarget(
            camera,
            random.integers(0, 6, (28, 56)).astype(np.uint8),
            random.uniform(0, 80, (28, 56)).astype(np.float32),
        )
        for camera in (FRONT_WIDE, FRONT_TELE)
    )
    if index % 3 == 0:
        scene = replace(scene, scene=replace(scene.scene, route=None))
    return replace(scene, dense=dense, seed=index // 4)
