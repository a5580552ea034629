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

from looktwice.model.driving.scene import Scene, SceneError
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.network.fact_reader import likely
from looktwice.model.network.intent import IntentTrunk, present_speeds
from looktwice.model.network.precision import bfloat16_is_fast
from looktwice.model.network.small_planner import SmallPlannerError
from looktwice.model.network.trajectory_head import TrajectoryHead


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
        self._loaded, self._intent = loaded, resampler.intent
        self.width_px = loaded.settings.image_width
        self._head = TrajectoryHead(IntentTrunk.width, loaded.codec, best=resampler.intent.sketch)

    @torch.inference_mode()
    def plan(self, scenes: Sequence[Scene]) -> FloatArray:
        """The best guess for each scene, float32 [n, 64, 4].

        Raises:
            SceneError: a scene has no route, or pictures that the checkpoint does not take.
        """
        facts = read_pictures(self._loaded, scenes)
        history, route, has_route = _motion(scenes)
        state = self._intent.state(facts, history, route, has_route).float()
        curves = self._head.curves(self._head(state).best, present_speeds(history))
        trajectories = np.zeros((len(scenes), FUTURE_STEPS, 4), np.float32)
        trajectories[..., [0, 1, 3]] = curves.numpy()
        return trajectories


@torch.inference_mode()
def read_pictures(loaded: Loaded, scenes: Sequence[Scene]) -> Tensor:
    """The facts that are read in pictures of scenes with a route, [n, len(FACTS)]; see `likely`.

    Raises:
        SceneError: a scene has no route, or pictures that the checkpoint does not take.
    """
    model, builder, settings = loaded.model, loaded.inputs, loaded.settings
    assert model.resampler is not None, "this checkpoint reads nothing in pictures"
    slices = [pictures for scene in scenes for pictures in builder.slices(scene)]
    patches = torch.from_numpy(np.concatenate([builder.patches(pictures) for pictures in slices]))
    grids = torch.tensor([settings.grid] * (len(scenes) * len(settings.cameras)))
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16_is_fast()):
        tokens = model.vision(patches, grids).float()
    gathered = model.resampler.gather(tokens.view(len(scenes), settings.vision_tokens, -1), *_motion(scenes))
    return likely(model.resampler.facts(gathered))


def _motion(scenes: Sequence[Scene]) -> tuple[Tensor, Tensor, Tensor]:
    """History, route, and that it is known."""
    for scene in scenes:
        if scene.route is None:
            raise SceneError(f"scene {scene.scene_id} has no route, which small planners need")
    return (
        torch.from_numpy(np.stack([scene.history for scene in scenes])),
        torch.from_numpy(np.stack([np.asarray(scene.route) for scene in scenes])),
        torch.ones(len(scenes), dtype=torch.bool),
    )
