"""Words that are none: what a small model misspells when it writes freely.

The dictionary is that of the texts which the small models learn from: the tokenizer's corpus and what the
built-in teacher writes. A model that writes English of its own uses more words than that; for it the count
says nothing.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Final

from looktwice.model.network.nano_corpus import driving_sentences

_TEACHERS: Final = """
allow am back be bends calls carry come do drawing drive drives ease eat fits foot get go going have hold
holding i lets like me metre metres mind mine miss moves much my needlessly nothing of off one out pick run
runs see sooner stands steer stretch stuck take unnecessary up what
"""
"""Words of the built-in teacher that the corpus lacks."""
_FILLINGS: Final = 200
"""Of each template of the corpus: every word of every slot comes up."""
_WORD: Final = re.compile(r"(?<![\w.])[^\W\d_]+(?:['\u2019-][^\W\d_]+)*")
"""Not the "s" of "1.2s"."""


def words_of(text: str) -> list[str]:
    """The words of a text in lower case; numbers are none."""
    return [word.casefold() for word in _WORD.findall(text)]


def unknown_words(text: str) -> list[str]:
    """The words of a text that are not in the dictionary, in its order."""
    return [word for word in words_of(text) if word not in _dictionary()]


@cache
def _dictionary() -> frozenset[str]:
    sentences = driving_sentences(per_template=_FILLINGS)
    return frozenset(word for text in (*sentences, _TEACHERS) for word in words_of(text))
