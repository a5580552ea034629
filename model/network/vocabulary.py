"""The words of a checkpoint: a Hugging Face tokenizer plus trajectory codes and markers.

Special tokens are spelt as in CF-VLA sections 7 and 8; the route's markers and the codes' spelling are ours.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from tokenizers import AddedToken, Regex, Tokenizer, decoders, models, pre_tokenizers, trainers
from transformers import PreTrainedTokenizerFast

from looktwice.model.families.trajectory_codes import CODES, TRAJECTORY
from looktwice.model.network.token_bytes import byte_level, is_text

END_OF_TEXT: Final = "<|endoftext|>"
IM_START: Final = "<|im_start|>"
IM_END: Final = "<|im_end|>"
VISION_START: Final = "<|vision_start|>"
VISION_END: Final = "<|vision_end|>"
VISION_PAD: Final = "<|vision_pad|>"
IMAGE_PAD: Final = "<|image_pad|>"
VIDEO_PAD: Final = "<|video_pad|>"
HISTORY_START: Final = "<|traj_history_start|>"
HISTORY: Final = "<|traj_history|>"
HISTORY_END: Final = "<|traj_history_end|>"
FUTURE_START: Final = "<|traj_future_start|>"
FUTURE_END: Final = "<|traj_future_end|>"
ROUTE_START: Final = "<|traj_route_start|>"
ROUTE: Final = "<|traj_route|>"
ROUTE_END: Final = "<|traj_route_end|>"
TRACKS_START: Final = "<|tracks_start|>"
TRACK: Final = "<|track|>"
TRACKS_END: Final = "<|tracks_end|>"

QWEN_TOKENS: Final = (
    END_OF_TEXT,
    IM_START,
    IM_END,
    VISION_START,
    VISION_END,
    VISION_PAD,
    IMAGE_PAD,
    VIDEO_PAD,
)
"""Markers that a stock Qwen2.5-VL tokenizer brings along."""
OUR_TOKENS: Final = (
    HISTORY_START,
    HISTORY,
    HISTORY_END,
    FUTURE_START,
    FUTURE_END,
    ROUTE_START,
    ROUTE,
    ROUTE_END,
)
"""Markers that are added to it, before the codes."""
TRACK_TOKENS: Final = (TRACKS_START, TRACK, TRACKS_END)
"""Markers behind the codes, for checkpoints that take tracks."""

# The pre-tokenisation of Qwen2 (transformers, models/qwen2): words with their leading space, single digits.
_QWEN_WORDS: Final = (
    r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}"
    r"| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
)
# A nano model's words besides: where a meta-action begins, "  - 0.5s-", and a time alone. Both are read and
# written thousands of times; in single digits they make three quarters of a response's tokens.
_PLAN_WORDS: Final = r"  - \d\.\ds-|\d\.\d"
_NUMBER: Final = re.compile(r"<\|([a-z_]+)_(\d{4})\|>")
"""The spelling of a number of an alphabet; see `number_token`."""
_ENCODE_CACHE: Final = 4096


class VocabularyError(ValueError):
    """A tokenizer that lacks what LookTwice needs; the text says what is missing."""


class Vocabulary:
    """What formats, engine and training need to know about a tokenizer.

    Its length counts the tokenizer's tokens; a network may have more rows, which are never allowed.

    Raises:
        VocabularyError: markers or trajectory codes are missing, or codes do not lie side by side.
    """

    def __init__(self, tokenizer: Any) -> None:
        # Typed loosely: transformers ships no precise types for its tokenizers.
        self.tokenizer = tokenizer
        self._backend: Any = self.tokenizer.backend_tokenizer
        self._ids: dict[str, int] = self._backend.get_vocab(with_added_tokens=True)
        self._length: int = max(self._ids.values(), default=-1) + 1
        missing = [token for token in (*QWEN_TOKENS, *OUR_TOKENS) if token not in self._ids]
        if missing:
            raise VocabularyError(f"the tokenizer lacks {', '.join(missing)}")
        self.codec_size = self._count_codes()
        self._numbers = self._find_numbers()
        self._free: dict[bool, npt.NDArray[np.bool_]] = {}
        self._encode = lru_cache(_ENCODE_CACHE)(self._encode_now)

    def __len__(self) -> int:
        return self._length

    def encode(self, text: str) -> tuple[int, ...]:
        """Token ids of ``text`` exactly as given; special tokens are recognised by their spelling."""
        return self._encode(text)

    def decode(self, ids: Iterable[int]) -> str:
        """The text of tokens, special ones spelt out; bytes that are not UTF-8 become U+FFFD."""
        text: str = self._backend.decode([int(token) for token in ids], skip_special_tokens=False)
        return text

    def id_of(self, token: str) -> int:
        """The id of one token by its spelling; raises `VocabularyError` where there is none."""
        if token not in self._ids:
            raise VocabularyError(f"the tokenizer has no token {token!r}")
        return self._ids[token]

    def code_ids(self, stage: int) -> range:
        """Ids of the codes of one stage 0..5."""
        first = self.id_of(code_token(stage, 0))
        return range(first, first + self.codec_size)

    @cached_property
    def alphabets(self) -> Mapping[str, tuple[range, ...]]:
        """Named alphabets of codes: for each codebook the ids of its tokens.

        Those of the trajectory codes, and those of numbers that the checkpoint writes as one token each.
        """
        return {TRAJECTORY: tuple(map(self.code_ids, range(CODES))), **self._numbers}

    def free_text_ids(self, *, multiline: bool = False) -> npt.NDArray[np.bool_]:
        """Mask bool [len(self)] of tokens that free text may hold.

        These are ordinary tokens (no markers, no codes) whose bytes are printable UTF-8 on their own: no
        halves of a character that could join into one, and no line breaks but, with ``multiline``, ``\\n``.
        """
        if multiline not in self._free:
            added = set(self._backend.get_added_tokens_decoder())
            mask = np.zeros(self._length, np.bool_)
            for token, index in self._ids.items():
                mask[index] = index not in added and _is_printable(token, multiline)
            mask.flags.writeable = False
            self._free[multiline] = mask
        return self._free[multiline]

    def _encode_now(self, text: str) -> tuple[int, ...]:
        return tuple(self._backend.encode(text, add_special_tokens=False).ids)

    def _find_numbers(self) -> dict[str, tuple[range]]:
        sizes = Counter(found[1] for token in self._ids if (found := _NUMBER.fullmatch(token)))
        alphabets = {}
        for name, size in sizes.items():
            first = self._ids.get(number_token(name, 0), -1)
            if any(self._ids.get(number_token(name, number)) != first + number for number in range(size)):
                raise VocabularyError(f"the numbers of {name!r} must be {size} tokens side by side")
            alphabets[name] = (range(first, first + size),)
        return alphabets

    def _count_codes(self) -> int:
        size = 0
        while code_token(0, size) in self._ids:
            size += 1
        if not size:
            raise VocabularyError(f"the tokenizer lacks trajectory codes such as {code_token(0, 0)}")
        for stage in range(CODES):
            first = self._ids.get(code_token(stage, 0), -1)
            if any(self._ids.get(code_token(stage, code)) != first + code for code in range(size)):
                raise VocabularyError(f"the codes of stage {stage} must be {size} tokens side by side")
        return size


def code_token(stage: int, code: int) -> str:
    """The spelling of a trajectory code, e.g. ``<|traj_0_017|>``."""
    return f"<|traj_{stage}_{code:03d}|>"


def number_token(alphabet: str, number: int) -> str:
    """The spelling of a number of an alphabet, counted from the least, e.g. ``<|x_m_0123|>``."""
    return f"<|{alphabet}_{number:04d}|>"


def build_nano_tokenizer(
    corpus: Iterable[str],
    codec_size: int,
    size: int = 3072,
    phrases: Iterable[str] = (),
    numbers: Mapping[str, int] = MappingProxyType({}),
) -> PreTrainedTokenizerFast:
    """A byte-level BPE tokenizer trained on ``corpus``, with all markers and 6 x ``codec_size`` codes.

    Args:
        corpus: texts whose words should be short in tokens; any text can be encoded.
        codec_size: codes per stage.
        size: ordinary tokens, at least the 256 bytes; fewer when the corpus has no more repeated parts.
        phrases: runs of text that count as one word, so that a corpus that holds them makes each a single
            token. A decimal and the beginning of a meta-action are such words too, phrases or not.
        numbers: sizes of alphabets of numbers.
    """
    backend = Tokenizer(models.BPE())
    words = [re.escape(phrase) for phrase in sorted(phrases, key=len, reverse=True)]
    pattern = "|".join([*words, _PLAN_WORDS, _QWEN_WORDS])
    backend.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(Regex(pattern), behavior="isolated"),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    backend.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=size, initial_alphabet=pre_tokenizers.ByteLevel.alphabet(), show_progress=False
    )
    backend.train_from_iterator(corpus, trainer)
    tokenizer_class: Any = PreTrainedTokenizerFast
    tokenizer = tokenizer_class(
        tokenizer_object=backend,
        eos_token=IM_END,
        pad_token=END_OF_TEXT,
        clean_up_tokenization_spaces=False,
    )
    _add(tokenizer, QWEN_TOKENS, special=True)
    expand_tokenizer(tokenizer, codec_size)
    add_numbers(tokenizer, numbers)
    result: PreTrainedTokenizerFast = tokenizer
    return result


def expand_tokenizer(tokenizer: Any, codec_size: int) -> int:
    """Add our markers and codes to a Qwen2.5-VL tokenizer in place; returns how many tokens were new."""
    before = len(tokenizer)
    _add(tokenizer, OUR_TOKENS, special=True)
    codes = [code_token(stage, code) for stage in range(CODES) for code in range(codec_size)]
    # Not special: grammars of other engines only see ordinary tokens.
    _add(tokenizer, codes, special=False)
    _add(tokenizer, TRACK_TOKENS, special=True)
    return len(tokenizer) - before


def add_numbers(tokenizer: Any, sizes: Mapping[str, int]) -> None:
    """Add alphabets of numbers to a tokenizer in place, behind all its tokens; those that it has are kept."""
    tokens = [number_token(name, number) for name, size in sizes.items() for number in range(size)]
    # Not special, as codes are not.
    _add(tokenizer, tokens, special=False)


def _add(tokenizer: Any, tokens: Iterable[str], *, special: bool) -> None:
    added = [AddedToken(token, normalized=False, special=special) for token in tokens]
    tokenizer.add_tokens(added, special_tokens=special)


def _is_printable(token: str, multiline: bool) -> bool:
    try:
        return is_text(byte_level(token), multiline=multiline)
    except KeyError:
        return False
