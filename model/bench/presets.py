"""Checkpoints of published sizes with random weights: what a size costs, not what it knows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import torch
from transformers import Qwen2_5_VLConfig

from looktwice.model.network.checkpoint import read_parts, save
from looktwice.model.network.vla import LookTwiceVla, padded_size, with_settings
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.network.vocabulary import END_OF_TEXT, IM_END


@dataclass(frozen=True)
class Preset:
    """A backbone's size, and the pictures that it is given.

    Attributes:
        text, vision: entries of `Qwen2_5_VLConfig`.
        image_width, image_height: pixels.
    """

    text: dict[str, Any]
    vision: dict[str, Any]
    image_width: int
    image_height: int


PRESETS: Final = {
    # Qwen2.5-VL-3B, and CF-VLA's pictures (section 8) brought to whole merged patches: 796 -> 784.
    "cf-vla-3b": Preset(
        text={
            "vocab_size": 151_936,
            "hidden_size": 2048,
            "intermediate_size": 11_008,
            "num_hidden_layers": 36,
            "num_attention_heads": 16,
            "num_key_value_heads": 2,
            "max_position_embeddings": 128_000,
            "rms_norm_eps": 1e-6,
            "rope_parameters": {
                "rope_type": "default",
                "mrope_section": [16, 24, 24],
                "rope_theta": 1_000_000.0,
            },
        },
        vision={
            "depth": 32,
            "hidden_size": 1280,
            "intermediate_size": 3420,
            "num_heads": 16,
            "out_hidden_size": 2048,
            "patch_size": 14,
            "spatial_merge_size": 2,
            "temporal_patch_size": 2,
            "tokens_per_second": 2,
            "window_size": 112,
            "fullatt_block_indexes": [7, 15, 23, 31],
        },
        image_width=784,
        image_height=448,
    )
}


def write_random(preset: Preset, words_of: Path, folder: Path, *, device: str = "cpu", seed: int = 0) -> None:
    """Write a checkpoint of a preset's size with random weights in bfloat16.

    Args:
        words_of: a checkpoint whose tokenizer and codec it gets; spare rows of the vocabulary stay unused.
        folder: where it goes.
        device: where the weights are drawn.
        seed: decides them.
    """
    parts = read_parts(words_of)
    settings = replace(
        VlaSettings(),
        name=folder.name,
        codec_size=parts.codec.size,
        image_width=preset.image_width,
        image_height=preset.image_height,
        tokens_per_second=preset.vision["tokens_per_second"],
    )
    vocabulary = parts.vocabulary
    text = preset.text | {
        "vocab_size": max(preset.text["vocab_size"], padded_size(vocabulary)),
        "bos_token_id": vocabulary.id_of(END_OF_TEXT),
        "eos_token_id": vocabulary.id_of(IM_END),
        "pad_token_id": vocabulary.id_of(END_OF_TEXT),
    }
    config: Any = Qwen2_5_VLConfig(text_config=text, vision_config=preset.vision, tie_word_embeddings=True)
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.bfloat16)
    try:
        with torch.random.fork_rng(), torch.device(device):
            torch.manual_seed(seed)
            model = LookTwiceVla(with_settings(config, settings, vocabulary))
    finally:
        torch.set_default_dtype(default)
    save(folder, model, vocabulary, parts.codec, details={"random_weights": True})
