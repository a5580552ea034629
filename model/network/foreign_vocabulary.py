"""The words of a foreign checkpoint: whatever tokenizer it has, as formats need it.

Formats are written in pieces, and what tokens spell must be what the pieces say, byte for byte. So a token's
bytes are read from the tokenizer's table, and texts are put together from these: a tokenizer's own `decode`
takes a space away at the beginning of a text, and its `encode` may add one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from looktwice.model.formats.free_text import shortest_spelling
from looktwice.model.network.token_bytes import byte_level, is_text
from looktwice.model.network.vocabulary import VocabularyError

_SPACE: Final = "\u2581"
"""How sentencepiece spells a space."""
_STARTS: Final = ("", "\n")
"""Put before a text, as some tokenizers spell what a text begins with in another way."""
_ENCODE_CACHE: Final = 4096


class ForeignVocabulary:
    """What formats need to know about any fast tokenizer whose tokens spell text byte for byte.

    These are byte-level ones, such as those of GPT-2 and Qwen, and those that spell as sentencepiece does,
    such as those of Llama 2 and Gemma. It has no alphabets of codes.

    Args:
        tokenizer: of `transformers`.

    Raises:
        VocabularyError: it is of another kind; says which.
    """

    def __init__(self, tokenizer: Any) -> None:
        self._backend: Any = getattr(tokenizer, "backend_tokenizer", None)
        if self._backend is None:
            raise VocabularyError("it has no tokenizer.json: a fast tokenizer is needed")
        self._added: dict[int, str] = {
            index: added.content for index, added in self._backend.get_added_tokens_decoder().items()
        }
        spelt = _spelling(self._backend)
        self._bytes: dict[int, bytes] = {
            index: spelt(token)
            for token, index in self._backend.get_vocab(with_added_tokens=False).items()
            if index not in self._added
        }
        self._bytes |= {index: token.encode() for index, token in self._added.items()}
        self._length = max(self._bytes, default=-1) + 1
        self._free: dict[bool, npt.NDArray[np.bool_]] = {}
        self._encode = lru_cache(_ENCODE_CACHE)(self._encode_now)

    def __len__(self) -> int:
        return self._length

    @property
    def alphabets(self) -> Mapping[str, tuple[range, ...]]:
        """None at all."""
        return MappingProxyType({})

    @property
    def spellings(self) -> Mapping[int, bytes]:
        """The bytes of each token, by its id."""
        return self._bytes

    @cached_property
    def special(self) -> tuple[str, ...]:
        """The texts that are taken for markers wherever they stand, such as the end of a turn."""
        added = self._backend.get_added_tokens_decoder().values()
        return tuple(token.content for token in added if token.special)

    def encode(self, text: str) -> tuple[int, ...]:
        """Token ids of ``text`` exactly as given; raises `VocabularyError` where no tokens spell it."""
        return self._encode(text)

    def decode(self, ids: Iterable[int]) -> str:
        """The text of tokens, special ones spelt out; bytes that are not UTF-8 become U+FFFD."""
        return b"".join(self._bytes[int(token)] for token in ids).decode("utf-8", errors="replace")

    def free_text_ids(self, *, multiline: bool = False) -> npt.NDArray[np.bool_]:
        """Mask bool [len(self)] of tokens that free text may hold; see `Vocabulary.free_text_ids`."""
        if multiline not in self._free:
            mask = np.zeros(self._length, np.bool_)
            for index, spelt in self._bytes.items():
                ordinary = index not in self._added and bool(spelt)
                mask[index] = ordinary and is_text(spelt, multiline=multiline)
            mask.flags.writeable = False
            self._free[multiline] = mask
        return self._free[multiline]

    def _encode_now(self, text: str) -> tuple[int, ...]:
        for start in _STARTS:
            ids = self._backend.encode(start + text, add_special_tokens=False).ids
            if (found := self._ending(ids, text.encode())) is not None:
                return found
        shortest = shortest_spelling(text, self._ordinary)
        if shortest is None:
            raise VocabularyError(f"the tokenizer has no tokens that spell {text!r}")
        return shortest

    def _ending(self, ids: list[int], spelt: bytes) -> tuple[int, ...] | None:
        """The last of some tokens, as many as spell these bytes; None where none do."""
        place, left = len(ids), len(spelt)
        while left > 0 and place:
            place -= 1
            left -= len(self._bytes[ids[place]])
        ending = tuple(ids[place:])
        return ending if b"".join(self._bytes[token] for token in ending) == spelt else None

    @cached_property
    def _ordinary(self) -> dict[str, int]:
        ids = np.flatnonzero(self.free_text_ids(multiline=True)).tolist()
        return {self.decode([token]): token for token in ids}


def _spelling(backend: Any) -> Callable[[str], bytes]:
    """How a token of a tokenizer is spelt; raises `VocabularyError` where that depends on its neighbours."""
    steps = [] if backend.decoder is None else list(_steps(json.loads(backend.decoder.__getstate__())))
    kinds = {step["type"] for step in steps}
    if "ByteLevel" in kinds:
        return byte_level
    spaces = any(step["type"] == "Replace" and step.get("content") == " " for step in steps)
    if "Metaspace" in kinds or spaces:
        return (
            _sentencepiece if "ByteFallback" in kinds else lambda token: token.replace(_SPACE, " ").encode()
        )
    raise VocabularyError(
        "its tokenizer spells no text byte for byte: byte-level tokenizers can be served, and those that "
        f"spell as sentencepiece does; this one decodes by {', '.join(sorted(kinds)) or 'nothing'}"
    )


def _sentencepiece(token: str) -> bytes:
    if len(token) == 6 and token.startswith("<0x") and token.endswith(">"):
        return bytes.fromhex(token[3:5])
    return token.replace(_SPACE, " ").encode()


def _steps(decoder: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A decoder, and the decoders that it is made of."""
    yield decoder
    for each in decoder.get("decoders", ()):
        yield from _steps(each)
