"""Our network as vLLM runs it: its own Qwen2.5-VL, with our encoders of history and route.

Prompts come as token ids with one placeholder a clip, pictures as the patches that `InputBuilder` makes: no
processor of `transformers` takes part, and pictures are prepared alike for every engine.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Final

import numpy as np
import torch
from torch import Tensor
from vllm.config import VllmConfig
from vllm.model_executor.models.qwen2_5_vl import Qwen2_5_VLForConditionalGeneration
from vllm.multimodal import MULTIMODAL_REGISTRY
from vllm.multimodal.inputs import MultiModalFieldConfig
from vllm.multimodal.parse import ModalityDataItems, MultiModalDataParser
from vllm.multimodal.processing import (
    BaseDummyInputsBuilder,
    BaseMultiModalProcessor,
    BaseProcessingInfo,
    PromptReplacement,
)

from model.driving.trajectory import HISTORY_STEPS, ROUTE_POINTS
from model.network.encoders import HistoryEncoder, RouteEncoder
from model.network.settings import VlaSettings
from model.network.vision import normalised
from model.network.vocabulary import HISTORY, ROUTE, VIDEO_PAD

CLIPS: Final = "video"
"""Clips go by vLLM's own name for moving pictures: its rotary positions know that."""
PLACEHOLDERS: Final = {CLIPS: VIDEO_PAD, "history": HISTORY, "route": ROUTE}
"""The token that stands in a prompt for an item of each kind."""


class _Items(ModalityDataItems[Mapping[str, Tensor], Mapping[str, Tensor]]):
    """Tensors [items, ...] by the name under which the network takes them; they need no processing."""

    def get_count(self) -> int:
        return len(next(iter(self.data.values())))

    def get(self, index: int) -> Mapping[str, Tensor]:
        return {name: values[index] for name, values in self.data.items()}

    def get_processor_data(self) -> Mapping[str, object]:
        return {}

    def get_passthrough_data(self) -> Mapping[str, object]:
        return dict(self.data)


class _Parser(MultiModalDataParser):
    def __init__(self, settings: VlaSettings) -> None:
        super().__init__()
        self._settings = settings

    def _get_subparsers(self) -> Mapping[str, Any]:
        return {
            CLIPS: self._clips,
            # Copies: a scene's arrays are read-only, which torch warns about.
            "history": lambda values: _Items({"history": torch.tensor(values)}, "history"),
            "route": lambda values: _Items({"route": torch.tensor(values)}, "route"),
        }

    def _clips(self, patches: Any) -> _Items:
        count = len(patches)
        return _Items(
            {
                "pixel_values_videos": torch.as_tensor(patches),
                "video_grid_thw": torch.tensor([self._settings.grid] * count),
                "second_per_grid_ts": torch.full((count,), self._settings.seconds_per_slice),
            },
            CLIPS,
        )


class _Info(BaseProcessingInfo):
    @property
    def settings(self) -> VlaSettings:
        return VlaSettings.of_config(self.get_hf_config())

    def get_data_parser(self) -> MultiModalDataParser:
        return _Parser(self.settings)

    def get_supported_mm_limits(self) -> Mapping[str, int | None]:
        limits: dict[str, int | None] = {CLIPS: len(self.settings.cameras), "history": 1}
        return limits | ({"route": 1} if self.settings.with_route else {})

    def get_mm_max_tokens_per_item(self, seq_len: int, mm_counts: Mapping[str, int]) -> Mapping[str, int]:
        return {kind: self.settings.clip_tokens if kind == CLIPS else 1 for kind in mm_counts}


class _Dummies(BaseDummyInputsBuilder[_Info]):
    def get_dummy_text(self, mm_counts: Mapping[str, int]) -> str:
        return "".join(PLACEHOLDERS[kind] * count for kind, count in mm_counts.items())

    def get_dummy_mm_data(
        self, seq_len: int, mm_counts: Mapping[str, int], mm_options: Mapping[str, Any]
    ) -> dict[str, Any]:
        settings = self.info.settings
        slices, rows, columns = settings.grid
        width = 3 * settings.temporal_patch_size * settings.patch_size**2
        shapes: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
            CLIPS: ((slices * rows * columns, width), np.uint8),
            "history": ((HISTORY_STEPS, 4), np.float32),
            "route": ((ROUTE_POINTS, 2), np.float32),
        }
        return {
            kind: np.zeros((count, *shapes[kind][0]), shapes[kind][1])
            for kind, count in mm_counts.items()
            if count
        }


class _Processor(BaseMultiModalProcessor[_Info]):
    def _get_mm_fields_config(
        self, hf_inputs: Mapping[str, Any], hf_processor_mm_kwargs: Mapping[str, object]
    ) -> Mapping[str, MultiModalFieldConfig]:
        fields = {
            "pixel_values_videos": MultiModalFieldConfig.batched(CLIPS),
            "video_grid_thw": MultiModalFieldConfig.batched(CLIPS, keep_on_cpu=True),
            "second_per_grid_ts": MultiModalFieldConfig.batched(CLIPS, keep_on_cpu=True),
            "history": MultiModalFieldConfig.batched("history"),
            "route": MultiModalFieldConfig.batched("route"),
        }
        return {name: field for name, field in fields.items() if name in hf_inputs}

    def _get_prompt_updates(
        self, mm_items: Any, hf_processor_mm_kwargs: Mapping[str, object], out_mm_kwargs: Any
    ) -> Sequence[PromptReplacement]:
        words = self.info.get_tokenizer().get_vocab()
        counts = {CLIPS: self.info.settings.clip_tokens, "history": 1, "route": 1}
        return [
            PromptReplacement(kind, [words[token]], [words[token]] * counts[kind])
            for kind, token in PLACEHOLDERS.items()
        ]


@MULTIMODAL_REGISTRY.register_processor(_Processor, info=_Info, dummy_inputs=_Dummies)
class LookTwiceForVllm(Qwen2_5_VLForConditionalGeneration):
    """vLLM's Qwen2.5-VL with encoders whose outputs stand at the history's and the route's token."""

    # The trajectory codec lies beside the weights.
    allow_patterns_overrides: ClassVar = ["model*.safetensors"]

    def __init__(self, *, vllm_config: VllmConfig, prefix: str = "") -> None:
        super().__init__(vllm_config=vllm_config, prefix=prefix)
        hidden_size = self.config.text_config.hidden_size
        with self._mark_tower_model(vllm_config, {"history", "route"}):
            self.history_encoder = HistoryEncoder(hidden_size)
            if VlaSettings.of_config(self.config).with_route:
                self.route_encoder = RouteEncoder(hidden_size)

    @classmethod
    def get_placeholder_str(cls, modality: str, i: int) -> str | None:
        """The text that stands for an item."""
        return PLACEHOLDERS[modality]

    def iter_mm_grid_thw(self, mm_features: Iterable[Any]) -> Any:
        """Clips take rotary positions of their own; history and route count as text."""
        return super().iter_mm_grid_thw([each for each in mm_features if each.modality == CLIPS])

    def embed_multimodal(self, **kwargs: Any) -> tuple[Tensor, ...]:
        """Embeddings [tokens, hidden] of every item in order, each kind by itself."""
        embeddings: tuple[Tensor, ...] = ()
        if (patches := kwargs.get("pixel_values_videos")) is not None:
            embeddings += self._clip_tokens(patches, kwargs["video_grid_thw"])
        for kind in ("history", "route"):
            if (values := kwargs.get(kind)) is not None:
                encoder = getattr(self, f"{kind}_encoder")
                embeddings += tuple(encoder(values.to(self.visual.device))[:, None])
        return embeddings

    def _clip_tokens(self, patches: Tensor, grids: Tensor) -> tuple[Tensor, ...]:
        """Vision tokens of clips, from uint8 patches [clips, p, 1176]."""
        values = normalised(patches.flatten(0, 1).to(self.visual.device))
        tokens = self.visual(values.to(self.visual.dtype), grid_thw=grids.tolist())
        return tuple(tokens.view(len(patches), -1, tokens.shape[-1]))
