"""Our network as vLLM runs it: its own Qwen2.5-VL, with our encoders and resampler.

Prompts come as token ids with one placeholder an item, pictures as the patches that `InputBuilder` makes: no
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

from looktwice.model.engines.vllm.items import CLIPS, PLACEHOLDERS, kinds_of
from looktwice.model.network.encoders import HistoryEncoder, RouteEncoder
from looktwice.model.network.fine_vision import FineVision
from looktwice.model.network.intent import SketchBooks, SketchCodes, TrackReader
from looktwice.model.network.resampler import SceneResampler
from looktwice.model.network.vision import normalised
from looktwice.model.network.vla_settings import CONFIG_KEY, VlaSettings

_ON_CPU: Final = frozenset({"video_grid_thw", "second_per_grid_ts"})
"""Arrays that no kernel reads."""


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
        # Copies: a scene's arrays are read-only, which torch warns about.
        return {
            kind: lambda arrays, kind=kind: _Items(
                {name: torch.tensor(values) for name, values in arrays.items()}, kind
            )
            for kind in kinds_of(self._settings)
        }


class _Info(BaseProcessingInfo):
    @property
    def settings(self) -> VlaSettings:
        return VlaSettings.of_config(self.get_hf_config())

    def get_data_parser(self) -> MultiModalDataParser:
        return _Parser(self.settings)

    def get_supported_mm_limits(self) -> Mapping[str, int | None]:
        return {name: kind.items for name, kind in kinds_of(self.settings).items()}

    def get_mm_max_tokens_per_item(self, seq_len: int, mm_counts: Mapping[str, int]) -> Mapping[str, int]:
        return {name: kinds_of(self.settings)[name].tokens for name in mm_counts}


class _Dummies(BaseDummyInputsBuilder[_Info]):
    def get_dummy_text(self, mm_counts: Mapping[str, int]) -> str:
        return "".join(PLACEHOLDERS[name] * count for name, count in mm_counts.items())

    def get_dummy_mm_data(
        self, seq_len: int, mm_counts: Mapping[str, int], mm_options: Mapping[str, Any]
    ) -> dict[str, Any]:
        settings = self.info.settings
        empty = {
            name: {
                array: np.zeros((mm_counts[name], *shape), type)
                for array, (shape, type) in kind.arrays.items()
            }
            for name, kind in kinds_of(settings).items()
            if mm_counts.get(name)
        }
        if CLIPS in empty:
            # The tower walks along the grid, and a grid of zeros has no patch.
            empty[CLIPS]["video_grid_thw"][:] = settings.grid
        return empty


class _Processor(BaseMultiModalProcessor[_Info]):
    def _get_mm_fields_config(
        self, hf_inputs: Mapping[str, Any], hf_processor_mm_kwargs: Mapping[str, object]
    ) -> Mapping[str, MultiModalFieldConfig]:
        return {
            array: MultiModalFieldConfig.batched(name, keep_on_cpu=array in _ON_CPU)
            for name, kind in kinds_of(self.info.settings).items()
            for array in kind.arrays
            if array in hf_inputs
        }

    def _get_prompt_updates(
        self, mm_items: Any, hf_processor_mm_kwargs: Mapping[str, object], out_mm_kwargs: Any
    ) -> Sequence[PromptReplacement]:
        words = self.info.get_tokenizer().get_vocab()
        return [
            PromptReplacement(name, [words[PLACEHOLDERS[name]]], [words[PLACEHOLDERS[name]]] * kind.tokens)
            for name, kind in kinds_of(self.info.settings).items()
        ]


@MULTIMODAL_REGISTRY.register_processor(_Processor, info=_Info, dummy_inputs=_Dummies)
class LookTwiceForVllm(Qwen2_5_VLForConditionalGeneration):
    """vLLM's Qwen2.5-VL with our encoders, and our resampler where the checkpoint has one."""

    # The trajectory codec lies beside the weights.
    allow_patterns_overrides: ClassVar = ["model*.safetensors"]

    def __init__(self, *, vllm_config: VllmConfig, prefix: str = "") -> None:
        super().__init__(vllm_config=vllm_config, prefix=prefix)
        hidden_size = self.config.text_config.hidden_size
        self.settings = settings = VlaSettings.of_config(self.config)
        stages, second = settings.sketch_tokens, settings.second_sketch
        with self._mark_tower_model(vllm_config, {*kinds_of(settings)} - {CLIPS}):
            if stages:
                self.sketch_books = SketchBooks(stages, settings.codec_size, curves=second)
            self.history_encoder = HistoryEncoder(hidden_size)
            if settings.with_route:
                self.route_encoder = RouteEncoder(hidden_size)
            if settings.with_tracks:
                self.track_reader = TrackReader(hidden_size, sketches=stages > 0, second=second)
            if settings.fine_vision:
                self.fine_vision = FineVision(hidden_size, settings)
            if settings.scene_tokens:
                self.resampler = SceneResampler(
                    hidden_size,
                    settings.tower_tokens,
                    settings.scene_queries,
                    cameras=settings.cameras,
                    fine_tokens=settings.fine_tokens,
                    sketches=stages > 0,
                    second=second,
                )

    @classmethod
    def get_placeholder_str(cls, modality: str, i: int) -> str | None:
        """The text that stands for an item; vLLM's chat layout asks for it, ours does not use it."""
        return PLACEHOLDERS[modality]

    def iter_mm_grid_thw(self, mm_features: Iterable[Any]) -> Any:
        """Clips take rotary positions of their own; all else counts as text."""
        return super().iter_mm_grid_thw([each for each in mm_features if each.modality == CLIPS])

    def embed_multimodal(self, **kwargs: Any) -> tuple[Tensor, ...]:
        """Embeddings [tokens, hidden] of every item in order, each kind by itself."""
        embeddings: tuple[Tensor, ...] = ()
        device = self.visual.device
        if (patches := kwargs.get("pixel_values_videos")) is not None:
            embeddings += tuple(self._vision(patches.flatten(0, 1), len(patches)))
        if (patches := kwargs.get("scene_patches")) is not None:
            cameras = len(self.settings.cameras)
            tokens = self._vision(patches.flatten(0, 1), len(patches) * cameras)
            looks_along = (kwargs[f"scene_{name}"].to(device) for name in ("history", "route", "has_route"))
            tokens = tokens.view(len(patches), -1, tokens.shape[-1])
            embeddings += tuple(self.resampler(tokens, *looks_along, self._sketch_codes()))
        for kind in ("history", "route"):
            if (values := kwargs.get(kind)) is not None:
                encoder = getattr(self, f"{kind}_encoder")
                embeddings += tuple(encoder(values.to(device))[:, None])
        if (values := kwargs.get("tracks")) is not None:
            way = (kwargs[f"tracks_{name}"].to(device) for name in ("history", "route", "has_route"))
            embeddings += tuple(self.track_reader(values.to(device), *way, self._sketch_codes()))
        return embeddings

    def _sketch_codes(self) -> SketchCodes | None:
        """The codes that sketches are written in; None where there are no sketches."""
        if not self.settings.sketch_tokens:
            return None
        first: int = getattr(self.config, CONFIG_KEY)["code_token_id"]
        ids = first + torch.arange(self.settings.sketch_codes, device=self.sketch_books.books.device)
        return self.sketch_books.codes(self.language_model.embed_input_ids(ids))

    def _vision(self, patches: Tensor, clips: int) -> Tensor:
        """Vision tokens [clips, tokens, hidden] from uint8 patches [clips x p, width]."""
        values = normalised(patches.to(self.visual.device)).to(self.visual.dtype)
        tokens: Tensor = self.visual(values, grid_thw=[list(self.settings.grid)] * clips)
        tokens = tokens.view(clips, -1, tokens.shape[-1])
        if not self.settings.fine_vision:
            return tokens
        return torch.cat([tokens, self.fine_vision(values).to(tokens.dtype)], dim=1)
