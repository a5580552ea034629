"""A small vocabulary for format tests: bytes, a few merged words, special tokens, codes."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt

from model.formats.pieces import CODES, code_text

SPECIAL = ("<|im_end|>", "<|traj_future_start|>", "<|traj_future_end|>", "<|endoftext|>")
WORDS = ("Meta Actions:\n", " Keep", " Speed", " Lane", " Turn", "  - ", "s:", "s-", "th", "ing")


class ByteVocabulary:
    """Greedy longest match over words, then bytes; codes of ``size`` per stage."""

    def __init__(self, size: int = 16) -> None:
        self.size = size
        self.texts = [
            *SPECIAL,
            *(code_text(stage, code) for stage in range(CODES) for code in range(size)),
            *WORDS,
            *(chr(byte) for byte in range(128)),
        ]
        self._ids = {text: index for index, text in reversed(list(enumerate(self.texts)))}
        longest = sorted(self.texts, key=len, reverse=True)
        self._pattern = re.compile("|".join(map(re.escape, longest)), re.DOTALL)

    def __len__(self) -> int:
        return len(self.texts)

    def encode(self, text: str) -> tuple[int, ...]:
        return tuple(self._ids[found] for found in self._pattern.findall(text))

    def decode(self, ids: tuple[int, ...] | list[int]) -> str:
        return "".join(self.texts[index] for index in ids)

    def code_ids(self, stage: int) -> range:
        first = len(SPECIAL) + stage * self.size
        return range(first, first + self.size)

    def free_text_ids(self) -> npt.NDArray[np.bool_]:
        first = len(SPECIAL) + CODES * self.size
        return np.array(
            [
                index >= first and "\n" not in text and text.isprintable()
                for index, text in enumerate(self.texts)
            ]
        )
