"""Vision tokens of pictures that were seen lately: a planner's next request shows most of them again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from hashlib import blake2b

from torch import Tensor

Pictures = tuple[bytes, ...]
"""The encoded pictures of one time slice."""


class ClipCache:
    """Vision tokens by the pictures they were made of, the least recently used forgotten first.

    Args:
        max_bytes: of tensors kept; 0 keeps nothing.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._kept: OrderedDict[bytes, Tensor] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._kept)

    def tokens(
        self, slices: Sequence[Pictures], encode: Callable[[list[Pictures]], Sequence[Tensor]]
    ) -> list[Tensor]:
        """The vision tokens of every slice; those not kept come from one call of ``encode``."""
        keys = [_key(pictures) for pictures in slices]
        missing = {key: pictures for key, pictures in zip(keys, slices, strict=True) if key not in self._kept}
        made: dict[bytes, Tensor] = {}
        if missing:
            made.update(zip(missing, encode(list(missing.values())), strict=True))
        found = [made[key] if key in made else self._kept[key] for key in keys]
        for key, tokens in zip(keys, found, strict=True):
            self._keep(key, tokens)
        return found

    def _keep(self, key: bytes, tokens: Tensor) -> None:
        if key in self._kept:
            self._kept.move_to_end(key)
            return
        self._kept[key] = tokens
        self._bytes += tokens.nbytes
        while self._bytes > self._max_bytes:
            _, forgotten = self._kept.popitem(last=False)
            self._bytes -= forgotten.nbytes


def _key(pictures: Pictures) -> bytes:
    digest = blake2b(digest_size=16)
    for picture in pictures:
        digest.update(len(picture).to_bytes(8, "little"))
        digest.update(picture)
    return digest.digest()
