"""The small planner of pictures by itself: what it reads in a scene, and where it would drive.

A checkpoint's answers begin with it: its state and its sketch stand in the prompt. Alone it plans many times
as fast as the decoder, so it drives through the states that its own readings lead to, and scenes of them
teach it to read there.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from looktwice.model.driving.facts import facts_of
from looktwice.model.driving.scene import Scene, SceneError
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.network.fact_reader import likely, weighed
from looktwice.model.network.precision import bfloat16_is_fast
from looktwice.model.network.small_planner import SmallPlanner, SmallPlannerError, motion_of


def true_facts(scene: Scene) -> FloatArray:
    """float32 [len(FACTS)] of a scene with a route and tracks; raises `SceneError` for another one."""
    if scene.route is None or scene.tracks is None:
        raise SceneError(f"scene {scene.scene_id} lacks its route or its tracks, which tell the facts")
    return facts_of(scene.tracks, scene.route)


class ReadingPlanner:
    """Reads facts in pictures and plans by them, as a checkpoint's sketch does.

    Args:
        folder: of the checkpoint.

    Attributes:
        width_px: of the pictures that it takes.

    Raises:
        SmallPlannerError: the checkpoint reads nothing in pictures, or sketches nothing from it.
        CheckpointError: it cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        loaded = load(folder)
        resampler = loaded.model.resampler
        if resampler is None or resampler.intent.sketch is None:
            raise SmallPlannerError(
                f"{folder}: this checkpoint reads no facts in pictures or sketches nothing from them; "
                "`looktwice train read-scene` makes one that does"
            )
        self._loaded, self.width_px = loaded, loaded.settings.image_width
        self._planner = SmallPlanner("facts", loaded.codec).eval()
        self._planner.trunk.load_state_dict(resampler.intent.trunk.state_dict())
        self._planner.head.best.load_state_dict(resampler.intent.sketch.state_dict())

    def plan(self, scenes: Sequence[Scene]) -> FloatArray:
        """The best guess for each scene, float32 [n, 64, 4].

        Raises:
            SceneError: a scene has no route, or pictures that the checkpoint does not take.
        """
        return self._planner.plan(scenes, weighed(read_pictures(self._loaded, scenes)))

    def plan_by_facts(self, scenes: Sequence[Scene]) -> FloatArray:
        """The same, told the true facts in the place of those that are read.

        Raises:
            SceneError: a scene has no route, or no tracks to tell the facts by.
        """
        facts = torch.from_numpy(np.stack([true_facts(scene) for scene in scenes]))
        return self._planner.plan(scenes, weighed(facts))


@torch.inference_mode()
def read_pictures(loaded: Loaded, scenes: Sequence[Scene]) -> Tensor:
    """The facts that are read in pictures of scenes with a route, [n, len(FACTS)]; see `likely`.

    Raises:
        SceneError: a scene has no route, or pictures that the checkpoint does not take.
    """
    model, builder, settings = loaded.model, loaded.inputs, loaded.settings
    assert model.resampler is not None, "this checkpoint reads nothing in pictures"
    history, route = motion_of(scenes)
    has_route = torch.ones(len(scenes), dtype=torch.bool)
    slices = [pictures for scene in scenes for pictures in builder.slices(scene)]
    patches = torch.from_numpy(np.concatenate([builder.patches(pictures) for pictures in slices]))
    grids = torch.tensor([settings.grid] * (len(scenes) * len(settings.cameras)))
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16_is_fast()):
        tokens = model.vision(patches, grids).float()
    tokens = tokens.view(len(scenes), settings.vision_tokens, -1)
    gathered = model.resampler.gather(tokens, history, route, has_route)
    return likely(model.resampler.facts(gathered))
