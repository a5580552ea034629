"""What was worked out for pictures that were seen lately: a planner's next request shows most again."""

from __future__ import annotations

from contextlib import suppress
from hashlib import blake2b

from cachetools import LRUCache
from torch import Tensor

Pictures = tuple[bytes, ...]
"""The encoded pictures of one time slice."""


class ClipCache(LRUCache[bytes, Tensor]):
    """Tensors by the `digest` of the pictures they were made of, the least recently used forgotten first.

    Args:
        max_bytes: of tensors kept; 0 keeps nothing.
    """

    def __init__(self, max_bytes: int) -> None:
        super().__init__(max_bytes, getsizeof=lambda tokens: tokens.nbytes)

    def keep(self, key: bytes, tokens: Tensor) -> None:
        """Keep ``tokens``, and forget others until they fit; too large ones are not kept at all."""
        with suppress(ValueError):
            self[key] = tokens


def digest(pictures: Pictures) -> bytes:
    """What tells the pictures of one slice from all others."""
    hashed = blake2b(digest_size=16)
    for picture in pictures:
        hashed.update(len(picture).to_bytes(8, "little"))
        hashed.update(picture)
    return hashed.digest()
