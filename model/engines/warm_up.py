"""The first requests of an engine, before anybody waits for one."""

from __future__ import annotations

import numpy as np

from looktwice.model.driving.images import encode_jpeg
from looktwice.model.driving.scene import CLIP_FRAMES, FRONT_WIDE, Clip, Scene
from looktwice.model.driving.trajectory import HISTORY_STEPS
from looktwice.model.engines.engine import Controls, Engine, PlanRequest
from looktwice.model.families.family import Attempt
from looktwice.model.families.registry import family_named
from looktwice.model.network.model_card import ModelCard


def grey_scene(card: ModelCard) -> Scene:
    """A standing ego that sees nothing but grey, through the cameras of a checkpoint."""
    width, height = card.image_size
    picture = encode_jpeg(np.full((height, width, 3), 128, np.uint8))
    clips = tuple(Clip(camera, (picture,) * CLIP_FRAMES) for camera in card.cameras or (FRONT_WIDE,))
    return Scene("grey", clips, np.zeros((HISTORY_STEPS, 4), np.float32))


async def warm_up(engine: Engine) -> None:
    """Plan once for a grey scene in every format."""
    for format in engine.card.formats:
        family = family_named(format)
        standing = np.zeros((len(family.times_s), 4), np.float32)
        request = PlanRequest(
            f"warm-up {format}",
            grey_scene(engine.card),
            format,
            Controls(n=1),
            Attempt(standing, "Drive on.") if family.refines else None,
        )
        async for _ in engine.submit(request):
            pass
