"""A stock Qwen2.5-VL, tiny and untrained."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tokenizers import AddedToken, Tokenizer
from transformers import PreTrainedTokenizerFast, Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

from looktwice.model.network.vocabulary import QWEN_TOKENS, build_nano_tokenizer


def write_stock(folder: Path, spare_rows: int) -> PreTrainedTokenizerFast:
    """A tiny random Qwen2.5-VL as Qwen lays it out: windowed vision blocks, no tokens of ours."""
    made = build_nano_tokenizer(["slow down and keep the lane"] * 3, 1, size=300)
    plain = made.backend_tokenizer.to_str()
    text = json.loads(plain)
    text["added_tokens"] = []
    tokenizer: Any = PreTrainedTokenizerFast
    stock = tokenizer(
        tokenizer_object=Tokenizer.from_str(json.dumps(text)), clean_up_tokenization_spaces=False
    )
    stock.add_tokens([AddedToken(token, special=True, normalized=False) for token in QWEN_TOKENS], True)
    ids = {token: stock.convert_tokens_to_ids(token) for token in QWEN_TOKENS}
    config = Qwen2_5_VLConfig(
        text_config={
            "vocab_size": len(stock) + spare_rows,
            "hidden_size": 64,
            "intermediate_size": 96,
            "num_hidden_layers": 2,
            "num_attention_heads": 4,
            "num_key_value_heads": 2,
            "bos_token_id": ids["<|endoftext|>"],
            "eos_token_id": ids["<|im_end|>"],
            "pad_token_id": ids["<|endoftext|>"],
            "rope_parameters": {"rope_type": "default", "mrope_section": [2, 3, 3], "rope_theta": 1e6},
        },
        vision_config={
            "depth": 2,
            "hidden_size": 32,
            "intermediate_size": 48,
            "num_heads": 2,
            "out_hidden_size": 64,
            "window_size": 56,
            "fullatt_block_indexes": [1],
            "tokens_per_second": 2,
        },
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
    )
    torch.manual_seed(1)
    Qwen2_5_VLForConditionalGeneration(config).save_pretrained(folder)
    stock.save_pretrained(folder)
    result: PreTrainedTokenizerFast = stock
    return result
