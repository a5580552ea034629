"""What was worked out for pictures that were seen lately: a planner's next request shows most again."""

from __future__ import annotations

from collections import OrderedDict
from hashlib import blake2b

from torch import Tensor

Pictures = tuple[bytes, ...]
"""The encoded pictures of one time slice."""


class ClipCache:
    """Tensors by the pictures they were made of, the least recently used forgotten first.

    Args:
        max_bytes: of tensors kept; 0 keeps nothing.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._kept: OrderedDict[bytes, Tensor] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._kept)

    def find(self, key: bytes) -> Tensor | None:
        """What is kept under a `digest`."""
        if key not in self._kept:
            return None
        self._kept.move_to_end(key)
        return self._kept[key]

    def keep(self, key: bytes, tokens: Tensor) -> None:
        """Keep ``tokens``, and forget others until they fit; too large ones are not kept at all."""
        if key in self._kept or tokens.nbytes > self._max_bytes:
            return
        self._kept[key] = tokens
        self._bytes += tokens.nbytes
        while self._bytes > self._max_bytes:
            _, forgotten = self._kept.popitem(last=False)
            self._bytes -= forgotten.nbytes


def digest(pictures: Pictures) -> bytes:
    """What tells the pictures of one slice from all others."""
    hashed = blake2b(digest_size=16)
    for picture in pictures:
        hashed.update(len(picture).to_bytes(8, "little"))
        hashed.update(picture)
    return hashed.digest()
