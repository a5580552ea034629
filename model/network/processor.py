"""Our inputs behind `transformers`' processors: what `AutoProcessor` gives for a checkpoint folder."""

from __future__ import annotations

from typing import Any

import torch
from transformers import BatchFeature, ProcessorMixin

from looktwice.model.driving.scene import Scene
from looktwice.model.families.family import Attempt
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.vla_settings import CONFIG_KEY, VlaSettings
from looktwice.model.network.vocabulary import Vocabulary


class LookTwiceProcessor(ProcessorMixin):
    """Makes the network's inputs of a scene.

    Args:
        tokenizer: with our markers and codes.
        looktwice: the checkpoint's settings, as in its ``config.json``.
        chat_template: writes the prompt that `looktwice.model.network.chat_prompt` writes.
    """

    def __init__(
        self, tokenizer: Any = None, looktwice: dict[str, Any] | None = None, chat_template: str | None = None
    ) -> None:
        super().__init__(tokenizer, chat_template=chat_template)  # type: ignore[no-untyped-call]
        self.looktwice = looktwice or {}
        self.inputs = InputBuilder(Vocabulary(tokenizer), VlaSettings.from_dict(self.looktwice))

    def __call__(
        self, scene: Scene, format: str | None = None, attempt: Attempt | None = None
    ) -> BatchFeature:
        """One scene as tensors with a batch of one, for the network's `forward`.

        The prompt asks for a response in the format of that name, or in the checkpoint's first.

        Keys are ``input_ids`` and ``attention_mask`` [1, t], ``pixel_values_videos`` [p, 1176],
        ``video_grid_thw`` [cameras, 3], ``history`` [1, 16, 4] and, where scene and checkpoint have them,
        ``route`` [1, 20, 2] and ``tracks`` [1, 16, features].

        Raises:
            SceneError, ImageError, FamilyError: as `InputBuilder.build`.
        """
        built = self.inputs.build(scene, format or self.inputs.settings.formats[0], attempt)
        ids = torch.from_numpy(built.prompt.ids.copy())[None]
        given = {"history": built.history, "route": built.route, "tracks": built.tracks}
        return BatchFeature(
            {
                "input_ids": ids,
                "attention_mask": torch.ones_like(ids),
                "pixel_values_videos": torch.from_numpy(built.pixel_values_videos),
                "video_grid_thw": torch.from_numpy(built.video_grid_thw),
                **{name: torch.tensor(value)[None] for name, value in given.items() if value is not None},
            }
        )


def processor_config(settings: VlaSettings) -> dict[str, Any]:
    """What ``processor_config.json`` says of a checkpoint with these settings."""
    return {
        "processor_class": LookTwiceProcessor.__name__,
        "auto_map": {"AutoProcessor": f"processing_looktwice.{LookTwiceProcessor.__name__}"},
        CONFIG_KEY: settings.to_dict(),
    }
