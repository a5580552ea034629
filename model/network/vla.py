"""The network: `transformers`' Qwen2.5-VL, unchanged, with continuous tokens for history and route.

A checkpoint is a Qwen2.5-VL checkpoint (same model type, same names of weights) with two small encoders
more and our settings under ``looktwice`` in its configuration; ``architectures`` names this class, by
which other engines find their own implementation.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn
from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

from looktwice.model.driving.trajectory import ROUTE_POINTS, FloatArray
from looktwice.model.network.encoders import HistoryEncoder, RouteEncoder
from looktwice.model.network.fact_reader import likely
from looktwice.model.network.fine_vision import FineVision
from looktwice.model.network.inputs import ModelInputs, Prompt, rotary_positions
from looktwice.model.network.intent import SketchBooks, SketchCodes, TrackReader
from looktwice.model.network.resampler import SceneResampler
from looktwice.model.network.vision import attends_to_whole_pictures, encode_pictures, normalised
from looktwice.model.network.vla_settings import CONFIG_KEY, VlaSettings
from looktwice.model.network.vocabulary import (
    END_OF_TEXT,
    HISTORY,
    IM_END,
    IMAGE_PAD,
    ROUTE,
    TRACK,
    VIDEO_PAD,
    VISION_END,
    VISION_START,
    Vocabulary,
)

VlaConfig = Any
"""`Qwen2_5_VLConfig`, with our settings as its attribute ``looktwice``; typed loosely, as its parts are
declared as dictionaries that they never are."""

_VOCABULARY_MULTIPLE = 64
"""Rows of the embedding are padded to this, for fast matrix products."""


class PromptEmbeddings(NamedTuple):
    """A prompt ready for the decoder.

    Attributes:
        embeddings: [t, hidden].
        position_ids: int64 [3, t] rotary positions.
        position_offset: a token's rotary position behind the prompt is its place + this offset.
    """

    embeddings: Tensor
    position_ids: Tensor
    position_offset: int


class LookTwiceVla(Qwen2_5_VLForConditionalGeneration):  # type: ignore[no-untyped-call]
    """Qwen2.5-VL whose embeddings at the history's and the route's token come from encoders."""

    def __init__(self, config: VlaConfig) -> None:
        super().__init__(config)
        self.settings = VlaSettings.of_config(config)
        extra = getattr(config, CONFIG_KEY)
        self.history_token_id: int = extra["history_token_id"]
        self.route_token_id: int = extra["route_token_id"]
        hidden_size = config.text_config.hidden_size
        self.history_encoder = HistoryEncoder(hidden_size)
        self.route_encoder = RouteEncoder(hidden_size) if self.settings.with_route else None
        stages, second = self.settings.sketch_tokens, self.settings.second_sketch
        size = self.settings.codec_size
        self.sketch_books = SketchBooks(stages, size, curves=second) if stages else None
        self.code_token_id: int | None = extra.get("code_token_id")
        self.track_reader = (
            TrackReader(hidden_size, sketches=stages > 0, second=second)
            if self.settings.with_tracks
            else None
        )
        self.track_token_id: int | None = extra.get("track_token_id")
        self.resampler = (
            SceneResampler(
                hidden_size,
                self.settings.tower_tokens,
                self.settings.scene_queries,
                cameras=self.settings.cameras,
                fine_tokens=self.settings.fine_tokens,
                sketches=stages > 0,
                second=second,
            )
            if self.settings.scene_tokens
            else None
        )
        self.fine_vision = FineVision(hidden_size, self.settings) if self.settings.fine_vision else None
        self._fast_vision = attends_to_whole_pictures(config.vision_config)
        self.post_init()  # type: ignore[no-untyped-call]

    def vision(
        self,
        patches: Tensor,
        grid_thw: Tensor,
        tower: nn.Module | None = None,
        fine_vision: nn.Module | None = None,
    ) -> Tensor:
        """Vision tokens [k, hidden] of clips, one after the other; independent of each other.

        Args:
            patches: [p, 1176], normalised floats as Qwen2.5-VL's processor makes them, or uint8, which
                are normalised on the way (a quarter of the memory to move).
            grid_thw: int64 [clips, 3], slices, rows, columns of patches.
            tower, fine_vision: copies of these parts in another type, to be used in their place.
        """
        tokens = self.tower_tokens(patches, grid_thw, tower)
        if self.fine_vision is None:
            return tokens
        fine = (fine_vision or self.fine_vision)(patches)
        coarse = tokens.view(len(grid_thw), -1, tokens.shape[-1])
        return torch.cat([coarse, fine.to(coarse.dtype)], dim=1).flatten(0, 1)

    def tower_tokens(self, patches: Tensor, grid_thw: Tensor, tower: nn.Module | None = None) -> Tensor:
        """Those of `vision` that the tower makes."""
        visual: Any = self.model.visual if tower is None else tower
        grids = set(map(tuple, grid_thw.tolist()))
        if self._fast_vision and len(grids) == 1 and not visual.gradient_checkpointing:
            _, rows, columns = grids.pop()
            return encode_pictures(visual, patches, rows, columns)
        if patches.dtype == torch.uint8:
            patches = normalised(patches)
        features: Tensor = visual(
            patches.to(visual.dtype), grid_thw.to(patches.device), return_dict=True
        ).pooler_output
        return features

    def embed(
        self,
        input_ids: Tensor,
        vision_tokens: Tensor | None = None,
        history: Tensor | None = None,
        route: Tensor | None = None,
        tracks: Tensor | None = None,
    ) -> Tensor:
        """Input embeddings [b, t, hidden] with pictures, histories, routes and tracks in their places.

        Args:
            input_ids: int64 [b, t].
            vision_tokens: [k, hidden] from `vision`, of all clips of the batch in order.
            history: [b, 16, 4].
            route: [b, 20, 2]; rows whose prompt has no route token are ignored.
            tracks: [b, 16, features]; rows whose prompt has no track tokens are ignored.
        """
        embeddings: Tensor = self.get_input_embeddings()(input_ids)
        if vision_tokens is not None and self.resampler is not None:
            assert history is not None, "the resampler needs the history"
            vision_tokens = self.resample(vision_tokens, *self._way(history, route, input_ids))
        if vision_tokens is not None:
            here = (input_ids == self.config.video_token_id)[..., None]
            embeddings = embeddings.masked_scatter(here, vision_tokens.to(embeddings.dtype))
        for token_id, encoder, values in (
            (self.history_token_id, self.history_encoder, history),
            (self.route_token_id, self.route_encoder, route),
        ):
            if values is not None and encoder is not None:
                here = (input_ids == token_id)[..., None]
                embeddings = torch.where(here, encoder(values)[:, None].to(embeddings.dtype), embeddings)
        if tracks is not None and self.track_reader is not None:
            assert history is not None, "the reader of tracks needs the history"
            places = torch.eq(input_ids, self.track_token_id or 0)
            rows = places.any(dim=1)
            way = (part[rows] for part in self._way(history, route, input_ids))
            tokens = self.track_reader(tracks[rows], *way, self._sketch_codes()).to(embeddings.dtype)
            embeddings = embeddings.masked_scatter(places[..., None], tokens)
        return embeddings

    def resample(self, vision_tokens: Tensor, history: Tensor, route: Tensor, has_route: Tensor) -> Tensor:
        """What the resampler makes of the clips of whole scenes, [b x scene_tokens, hidden]."""
        assert self.resampler is not None
        tokens = vision_tokens.view(len(history), self.settings.vision_tokens, -1)
        resampled: Tensor = self.resampler(tokens, history, route, has_route, self._sketch_codes())
        return resampled.flatten(0, 1)

    @torch.inference_mode()
    def read_facts(self, scene_tokens: Tensor) -> FloatArray | None:
        """Facts [len(FACTS)] that stand in a prompt's scene tokens, with their probabilities; None without.

        Args:
            scene_tokens: [scene_tokens, hidden], where the pictures stand in the prompt.
        """
        if self.resampler is None:
            return None
        read = likely(self.resampler.facts(scene_tokens[None].to(self.dtype)))
        return cast("FloatArray", read[0].cpu().numpy())

    def _sketch_codes(self) -> SketchCodes | None:
        """The codes that sketches are written in; None where there are no sketches."""
        if self.sketch_books is None:
            return None
        first = self.code_token_id or 0
        weight: Any = self.get_input_embeddings().weight
        return self.sketch_books.codes(weight[first : first + self.settings.sketch_codes])

    def _way(self, history: Tensor, route: Tensor | None, input_ids: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """History, route and which rows have one: those whose prompt [b, t] has the route's token."""
        if route is None:
            route = history.new_zeros(len(input_ids), ROUTE_POINTS, 2)
        return history, route, (input_ids == self.route_token_id).any(dim=1)

    def encode_prompt_embeddings(self, inputs: ModelInputs) -> PromptEmbeddings:
        """One scene's prompt, ready to be prefilled."""
        patches = torch.from_numpy(inputs.patches).to(self.device)
        vision_tokens = self.vision(patches, torch.from_numpy(inputs.video_grid_thw))
        return self.embed_prompt(inputs.prompt, vision_tokens, inputs.history, inputs.route, inputs.tracks)

    def embed_prompt(
        self,
        prompt: Prompt,
        vision_tokens: Tensor,
        history: FloatArray,
        route: FloatArray | None,
        tracks: FloatArray | None = None,
    ) -> PromptEmbeddings:
        """A prompt whose pictures are encoded: ``vision_tokens`` [k, hidden] of all its clips."""
        device = self.device
        embeddings = self.embed(
            torch.from_numpy(prompt.ids).to(device)[None],
            vision_tokens,
            _tensor(history, device)[None],
            None if route is None else _tensor(route, device)[None],
            None if tracks is None else _tensor(tracks, device)[None],
        )
        positions = torch.from_numpy(prompt.position_ids).to(device)
        return PromptEmbeddings(embeddings[0], positions, prompt.position_offset)

    def position_ids(self, input_ids: Tensor, attention_mask: Tensor | None = None) -> Tensor:
        """Rotary positions int64 [3, b, t] of whole sequences; zeros where the mask is 0."""
        ids = input_ids.cpu().numpy()
        mask = np.ones_like(ids, np.bool_) if attention_mask is None else attention_mask.cpu().numpy() > 0
        positions = np.zeros((3, *ids.shape), np.int64)
        for row in range(len(ids)):
            is_video = ids[row][mask[row]] == self.config.video_token_id
            positions[:, row, mask[row]] = rotary_positions(is_video, self.settings)
        return torch.from_numpy(positions).to(input_ids.device)

    def forward(
        self,
        input_ids: Tensor | None = None,
        attention_mask: Tensor | None = None,
        position_ids: Tensor | None = None,
        past_key_values: Any = None,
        inputs_embeds: Tensor | None = None,
        labels: Tensor | None = None,
        pixel_values_videos: Tensor | None = None,
        video_grid_thw: Tensor | None = None,
        history: Tensor | None = None,
        route: Tensor | None = None,
        tracks: Tensor | None = None,
        **kwargs: Any,
    ) -> Any:
        """As Qwen2.5-VL's, with ``history`` [b, 16, 4], ``route`` [b, 20, 2] and ``tracks`` for their tokens.

        ``position_ids`` [3, b, t] are worked out here for whole sequences when they are not given.
        """
        if input_ids is not None and inputs_embeds is None:
            tokens = None
            if pixel_values_videos is not None:
                assert video_grid_thw is not None, "pixel_values_videos need video_grid_thw"
                tokens = self.vision(pixel_values_videos, video_grid_thw)
            inputs_embeds = self.embed(input_ids, tokens, history, route, tracks)
            if position_ids is None and (past_key_values is None or not past_key_values.get_seq_length()):
                position_ids = self.position_ids(input_ids, attention_mask)
        kwargs.pop("mm_token_type_ids", None)
        return super().forward(
            attention_mask=attention_mask,
            position_ids=position_ids,
            past_key_values=past_key_values,
            inputs_embeds=inputs_embeds,
            labels=labels,
            **kwargs,
        )


def _tensor(array: np.ndarray[Any, Any], device: torch.device) -> Tensor:
    # A copy: arrays of scenes are read-only, which torch warns about.
    return torch.tensor(array, device=device)


def with_settings(config: VlaConfig, settings: VlaSettings, vocabulary: Vocabulary) -> VlaConfig:
    """``config`` (changed in place) with our settings and this vocabulary's ids and size."""
    setattr(
        config,
        CONFIG_KEY,
        settings.to_dict()
        | {"history_token_id": vocabulary.id_of(HISTORY), "route_token_id": vocabulary.id_of(ROUTE)}
        | ({"track_token_id": vocabulary.id_of(TRACK)} if settings.with_tracks else {})
        | ({"code_token_id": vocabulary.code_ids(0).start} if settings.sketch_tokens else {}),
    )
    config.architectures = [LookTwiceVla.__name__]
    config.image_token_id = vocabulary.id_of(IMAGE_PAD)
    config.video_token_id = vocabulary.id_of(VIDEO_PAD)
    config.vision_start_token_id = vocabulary.id_of(VISION_START)
    config.vision_end_token_id = vocabulary.id_of(VISION_END)
    config.text_config.bos_token_id = vocabulary.id_of(END_OF_TEXT)
    config.text_config.eos_token_id = vocabulary.id_of(IM_END)
    config.text_config.pad_token_id = vocabulary.id_of(END_OF_TEXT)
    return config


def padded_size(vocabulary: Vocabulary) -> int:
    """Embedding rows for a vocabulary: its length rounded up."""
    return -(-len(vocabulary) // _VOCABULARY_MULTIPLE) * _VOCABULARY_MULTIPLE


def nano_config(vocabulary: Vocabulary, settings: VlaSettings | None = None) -> VlaConfig:
    """The configuration of the small model that is trained from scratch and shipped."""
    settings = settings or VlaSettings(codec_size=vocabulary.codec_size)
    hidden_size, depth = 256, 4
    config = Qwen2_5_VLConfig(
        text_config={
            "vocab_size": padded_size(vocabulary),
            "hidden_size": hidden_size,
            "intermediate_size": 768,
            "num_hidden_layers": 6,
            "num_attention_heads": 4,
            "num_key_value_heads": 2,
            "bos_token_id": vocabulary.id_of(END_OF_TEXT),
            "eos_token_id": vocabulary.id_of(IM_END),
            "pad_token_id": vocabulary.id_of(END_OF_TEXT),
            "max_position_embeddings": 4096,
            "rms_norm_eps": 1e-6,
            # Sections count pairs of a head's 64 dimensions: time, row, column.
            "rope_parameters": {"rope_type": "default", "mrope_section": [8, 12, 12], "rope_theta": 10000.0},
        },
        vision_config={
            "depth": depth,
            "hidden_size": 192,
            "intermediate_size": 576,
            "num_heads": 4,
            "out_hidden_size": hidden_size,
            "patch_size": settings.patch_size,
            "spatial_merge_size": settings.spatial_merge_size,
            "temporal_patch_size": settings.temporal_patch_size,
            "tokens_per_second": settings.tokens_per_second,
            # Pictures are small: every block sees the whole of one.
            "window_size": 112,
            "fullatt_block_indexes": list(range(depth)),
        },
        tie_word_embeddings=True,
    )
    return with_settings(config, settings, vocabulary)


def parameters_of(model: nn.Module) -> int:
    """How many weights a network has, tied ones once."""
    return cast("int", sum(parameter.numel() for parameter in model.parameters()))


def with_own_head(model: LookTwiceVla) -> None:
    """Give the head weights of its own where it has those of the embedding, so that they may differ."""
    model.lm_head.weight = nn.Parameter(model.lm_head.weight.detach().clone())
    config: Any = model.config
    for each in (config, config.text_config):
        each.tie_word_embeddings = False


def is_vision(name: str) -> bool:
    """Whether a weight belongs to what sees: the tower, or the resampler but for its small planner.

    Args:
        name: within the network, or within a module that holds it.
    """
    return is_tower(name) or (".resampler." in f".{name}" and ".intent." not in name)


def is_tower(name: str) -> bool:
    """Whether a weight belongs to the vision tower or what looks beside it; ``name`` as in `is_vision`."""
    name = f".{name}"
    return ".visual." in name or ".fine_vision." in name


def is_planner(name: str) -> bool:
    """Whether a weight belongs to a small planner; ``name`` as in `is_vision`."""
    name = f".{name}"
    return ".track_reader." in name or ".resampler.intent." in name
