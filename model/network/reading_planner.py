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
from looktwice.model.network.checkpoint import load
from looktwice.model.network.fact_reader import likely
from looktwice.model.network.intent import IntentTrunk, present_speeds
from looktwice.model.network.precision import fast_dtype
from looktwice.model.network.small_planner import SmallPlannerError
from looktwice.model.network.trajectory_head import TrajectoryHead


class ReadingPlanner:
    """Reads facts in pictures and plans by them, as a checkpoint's sketch does.

    Args:
        folder: of the checkpoint.

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
        self._vla, self._inputs, self._settings = loaded.model, loaded.inputs, loaded.settings
        self._vla.train(False)
        self._resampler = resampler
        self._head = TrajectoryHead(IntentTrunk.width, loaded.codec, best=resampler.intent.sketch)

    @torch.inference_mode()
    def plan(self, scenes: Sequence[Scene]) -> FloatArray:
        """The best guess for each scene, float32 [n, 64, 4].

        Raises:
            SceneError: a scene has no route, or pictures that the checkpoint does not take.
        """
        history = torch.from_numpy(np.stack([scene.history for scene in scenes]))
        route = torch.from_numpy(np.stack([self._route(scene) for scene in scenes]))
        has_route = torch.ones(len(scenes), dtype=torch.bool)
        gathered = self._resampler.gather(self._seen(scenes), history, route, has_route)
        facts = likely(self._resampler.facts(gathered))
        state = self._resampler.intent.state(facts, history, route, has_route).float()
        curves = self._head.curves(self._head(state).best, present_speeds(history))
        trajectories = np.zeros((len(scenes), FUTURE_STEPS, 4), np.float32)
        trajectories[..., [0, 1, 3]] = curves.numpy()
        return trajectories

    def _seen(self, scenes: Sequence[Scene]) -> Tensor:
        """Vision tokens float32 [n, v, hidden]."""
        slices = [pictures for scene in scenes for pictures in self._inputs.slices(scene)]
        patches = torch.from_numpy(np.concatenate([self._inputs.patches(each) for each in slices]))
        grids = torch.tensor([self._settings.grid] * (len(scenes) * len(self._settings.cameras)))
        with torch.autocast("cpu", torch.bfloat16, enabled=fast_dtype() == torch.bfloat16):
            tokens: Tensor = self._vla.vision(patches, grids)
        return tokens.float().view(len(scenes), self._settings.vision_tokens, -1)

    def _route(self, scene: Scene) -> FloatArray:
        route = self._inputs.route_of(scene)
        if route is None:
            raise SceneError(f"scene {scene.scene_id} has no route, which small planners need")
        return route
