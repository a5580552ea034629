"""Foreign checkpoints for tests: tiny random networks with tokenizers and processors of the common kinds."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import torch
from tokenizers import AddedToken, Tokenizer, decoders, models, normalizers, pre_tokenizers, trainers
from transformers import (
    CLIPVisionConfig,
    LlamaConfig,
    LlamaForCausalLM,
    LlavaConfig,
    LlavaForConditionalGeneration,
    LlavaProcessor,
    PreTrainedTokenizerFast,
)
from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

END, IMAGE = "<end>", "<image>"
CHAT: Final = (
    "{% for message in messages %}[{{ message.role }}] "
    "{% if message.content is string %}{{ message.content }}{% else %}{% for part in message.content %}"
    "{% if part.type == 'image' %}"
    + IMAGE
    + "{% else %}{{ part.text }}{% endif %}{% endfor %}{% endif %}"
    + END
    + "{% endfor %}{% if add_generation_prompt %}[assistant] {% endif %}"
)
_TEXT: Final = (
    "The car drives 12.5 m ahead. Keep Speed, Turn Left: [10.0, -3.5, 0.02]\n  - 0.0s-2.5s: Keep Lane\n"
)
_SIZES: Final[dict[str, Any]] = {
    "hidden_size": 32,
    "intermediate_size": 64,
    "num_hidden_layers": 2,
    "num_attention_heads": 4,
}
# With smaller weights all tokens are about as likely, wherever they stand.
_TEXT_SIZES: Final = _SIZES | {"num_key_value_heads": 2, "initializer_range": 0.5}


def byte_level_tokenizer() -> Any:
    """As GPT-2's and Qwen's."""
    backend = Tokenizer(models.BPE())
    backend.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    backend.decoder = decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    trainer = trainers.BpeTrainer(vocab_size=340, initial_alphabet=alphabet, show_progress=False)
    backend.train_from_iterator([_TEXT] * 9, trainer)
    return _with_markers(backend)


def sentencepiece_tokenizer() -> Any:
    """As Llama 2's: a space before every text, bytes for what it has no letter for."""
    letters = ["<unk>", *(f"<0x{byte:02X}>" for byte in range(256)), "\u2581", *map(chr, range(0x21, 0x7F))]
    merges = [
        ("\u2581", "t"),
        ("K", "e"),
        ("e", "p"),
        ("Ke", "ep"),
        ("\u2581", "Keep"),
        ("1", "2"),
        ("\u2581", "["),
    ]
    words = dict.fromkeys([*letters, *(one + other for one, other in merges)])
    vocabulary = {word: number for number, word in enumerate(words)}
    backend = Tokenizer(
        models.BPE(vocab=vocabulary, merges=merges, unk_token="<unk>", fuse_unk=True, byte_fallback=True)
    )
    backend.normalizer = normalizers.Sequence(
        [normalizers.Prepend("\u2581"), normalizers.Replace(" ", "\u2581")]
    )
    backend.decoder = decoders.Sequence(
        [
            decoders.Replace("\u2581", " "),
            decoders.ByteFallback(),
            decoders.Fuse(),
            decoders.Strip(" ", 1, 0),
        ]
    )
    return _with_markers(backend)


def wordpiece_tokenizer() -> Any:
    """As BERT's, which does not spell text byte for byte."""
    backend = Tokenizer(models.WordPiece({"[UNK]": 0, "the": 1, "##s": 2}, unk_token="[UNK]"))
    backend.decoder = decoders.WordPiece()
    return _with_markers(backend)


def _with_markers(backend: Tokenizer) -> Any:
    tokenizer_class: Any = PreTrainedTokenizerFast
    tokenizer = tokenizer_class(tokenizer_object=backend, eos_token=END)
    tokenizer.add_tokens([AddedToken(IMAGE, special=True)], special_tokens=True)
    tokenizer.chat_template = CHAT
    return tokenizer


def write_llm(folder: Path, tokenizer: Any, seed: int = 0, *, layers: int = 2) -> Path:
    """A language model that sees nothing."""
    sizes = _TEXT_SIZES | {"num_hidden_layers": layers}
    config = LlamaConfig(vocab_size=512, max_position_embeddings=8192, **sizes)
    return _write(folder, LlamaForCausalLM, config, tokenizer, seed)


def write_vlm(folder: Path, seed: int = 0) -> Path:
    """A LLaVA, whose pictures are 28 pixels wide and high."""
    tokenizer = byte_level_tokenizer()
    config = LlavaConfig(
        vision_config=CLIPVisionConfig(image_size=28, patch_size=14, **_SIZES),
        text_config=LlamaConfig(vocab_size=512, max_position_embeddings=8192, **_TEXT_SIZES),
        image_token_index=tokenizer.convert_tokens_to_ids(IMAGE),
        image_seq_length=4,
    )
    side = {"height": 28, "width": 28}
    processor_class: Any = LlavaProcessor
    processor = processor_class(
        CLIPImageProcessorPil(size={"shortest_edge": 28}, crop_size=side),
        tokenizer,
        patch_size=14,
        vision_feature_select_strategy="default",
        image_token=IMAGE,
        num_additional_image_tokens=1,
        chat_template=CHAT,
    )
    return _write(folder, LlavaForConditionalGeneration, config, processor, seed)


def _write(folder: Path, network: Any, config: Any, processor: Any, seed: int) -> Path:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network(config).save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder
