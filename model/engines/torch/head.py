"""Logits of the tokens that the format allows, and of no others.

A format often leaves a handful of tokens to choose from. The product with the whole vocabulary, as large as
a layer of a small network, would be thrown away but for those.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import torch
from cachetools import LRUCache
from torch import Tensor
from torch.nn import functional

_WHOLE_SHARE: Final = 0.5
"""Of the vocabulary: for more allowed tokens than this the whole product is as fast."""
_ALIKE: Final = 16
"""Products have a multiple of so many rows and columns, so that each of their numbers is added up in the
same order, whatever else is asked for."""
_PARTS: Final = 1024
"""Sets of ids whose weights are kept; a format has some tens of them."""

Ids = npt.NDArray[np.int64]


class AllowedHead:
    """The language model's head over sets of ids.

    Args:
        weight: [vocabulary, hidden]; not to be changed while the head is used.
    """

    def __init__(self, weight: Tensor) -> None:
        self._weight = weight.detach().t()
        # By what is in them: a fork makes its set anew each time.
        self._parts: LRUCache[bytes, Tensor | None] = LRUCache(_PARTS)

    def logits(self, hidden: Tensor, wanted: Sequence[Ids]) -> list[npt.NDArray[np.float64]]:
        """For each row of ``hidden`` [n, hidden] the logits of its wanted ids, float64 [k]."""
        rows_of: dict[bytes, list[int]] = {}
        for row, ids in enumerate(wanted):
            rows_of.setdefault(ids.tobytes(), []).append(row)
        parts = [self._part(key, wanted[rows[0]]) for key, rows in rows_of.items()]
        products = []
        for part, rows in zip(parts, rows_of.values(), strict=True):
            chosen = hidden if len(rows) == len(hidden) else hidden[rows]
            chosen = functional.pad(chosen, (0, 0, 0, -len(rows) % _ALIKE))
            product = torch.mm(chosen, self._weight if part is None else part)
            products.append(product[: len(rows), : len(wanted[rows[0]]) if part is not None else None])
        # All at once: on a GPU every copy waits for what was asked before.
        every = torch.cat([product.flatten() for product in products]).double().cpu().numpy()
        ends = np.cumsum([product.numel() for product in products])
        found: list[npt.NDArray[np.float64]] = [np.empty(0)] * len(wanted)
        flats = np.split(every, ends[:-1])
        for part, rows, flat in zip(parts, rows_of.values(), flats, strict=True):
            logits = flat.reshape(len(rows), -1)
            if part is None:
                logits = logits[:, wanted[rows[0]]]
            for row, values in zip(rows, logits, strict=True):
                found[row] = values
        return found

    def _part(self, key: bytes, ids: Ids) -> Tensor | None:
        """The weights of some ids, [hidden, k], kept by ``key``; None for the whole."""
        if key not in self._parts:
            part = None
            if len(ids) <= _WHOLE_SHARE * self._weight.shape[1]:
                wanted = torch.from_numpy(ids).to(self._weight.device)
                # Turned over in memory too: products of few rows read that faster.
                part = functional.pad(self._weight.index_select(1, wanted), (0, -len(ids) % _ALIKE))
            self._parts[key] = part
        found: Tensor | None = self._parts[key]
        return found
