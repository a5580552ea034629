"""A small vocabulary for format tests: bytes, a few merged words, special tokens, codes."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt

from looktwice.model.families.trajectory_codes import CODES

SPECIAL = ("<|im_end|>", "<|traj_future_start|>", "<|traj_future_end|>", "<|endoftext|>")
WORDS = (
    *("Meta Actions:\n", " Keep", " Speed", " Lane", " Turn", "  - ", "s:", "s-", "th", "ing"),
    *("</", "ink>", "nk>", "a<", ".\n", "\n\n", ", ", "12", "lost in"),
)
PAINTS, TENTHS = 8, 21
"""Sizes of the alphabets "paint" and "tenth", which have one codebook each."""


def code_text(stage: int, code: int) -> str:
    """The spelling of a trajectory code."""
    return f"<|traj_{stage}_{code:03d}|>"


class ByteVocabulary:
    """Greedy longest match over words, then bytes; trajectory codes of ``size`` per stage."""

    def __init__(self, size: int = 16) -> None:
        self.size = size
        codes = [
            *(code_text(stage, code) for stage in range(CODES) for code in range(size)),
            *(f"<paint {code}>" for code in range(PAINTS)),
            *(f"<tenth {code}>" for code in range(TENTHS)),
        ]
        self.special = len(SPECIAL) + len(codes)
        self.texts = [*SPECIAL, *codes, *WORDS, *(chr(byte) for byte in range(128))]
        self._ids = {text: index for index, text in reversed(list(enumerate(self.texts)))}
        longest = sorted(self.texts, key=len, reverse=True)
        self._pattern = re.compile("|".join(map(re.escape, longest)), re.DOTALL)
        paint, tenth = self._ids["<paint 0>"], self._ids["<tenth 0>"]
        self.alphabets = {
            "trajectory": tuple(map(self.code_ids, range(CODES))),
            "paint": (range(paint, paint + PAINTS),),
            "tenth": (range(tenth, tenth + TENTHS),),
        }

    def __len__(self) -> int:
        return len(self.texts)

    def encode(self, text: str) -> tuple[int, ...]:
        return tuple(self._ids[found] for found in self._pattern.findall(text))

    def decode(self, ids: tuple[int, ...] | list[int]) -> str:
        return "".join(self.texts[index] for index in ids)

    def code_ids(self, stage: int) -> range:
        first = len(SPECIAL) + stage * self.size
        return range(first, first + self.size)

    def free_text_ids(self, *, multiline: bool = False) -> npt.NDArray[np.bool_]:
        texts = [text.replace("\n", "") if multiline else text for text in self.texts]
        return np.array([index >= self.special and text.isprintable() for index, text in enumerate(texts)])
