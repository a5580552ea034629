"""Keys and values in rows: one KV row for a prompt and what is written behind it."""

from __future__ import annotations

import torch
from torch import Tensor


class KvRows:
    """Preallocated keys and values, [layers, rows, heads, length, head_dim] each.

    The lowest free row is used first, so that a pass over all that are in use reads one view of the first
    rows instead of gathering copies. Memory that no pass has reached yet is not touched, and on a CPU not
    taken from the system either.

    Attributes:
        flat: the same memory as [2, layers, rows x heads x length, head_dim].
    """

    def __init__(
        self,
        *,
        layers: int,
        heads: int,
        head_dim: int,
        rows: int,
        length: int,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self._both = torch.empty((2, layers, rows, heads, length, head_dim), dtype=dtype, device=device)
        self.flat = self._both.view(2, layers, -1, head_dim)
        self._reached = [0] * rows
        self.rows, self.heads, self.length = rows, heads, length

    def reach(self, rows: int, length: int) -> Tensor:
        """The first places of the first rows, [2, layers, rows, heads, length, head_dim].

        What was never written is zero and not garbage: masked places are multiplied by weights of zero, and
        0 x NaN would be NaN. So what was written and is no number is to be wiped.
        """
        for row in range(rows):
            if self._reached[row] < length:
                self._both[:, :, row, :, self._reached[row] : length] = 0
                self._reached[row] = length
        return self._both[:, :, :rows, :, :length]

    def row(self, row: int, length: int) -> Tensor:
        """The first places of one row, [2, layers, heads, length, head_dim]."""
        return self.reach(row + 1, length)[:, :, row]

    def wipe(self, row: int) -> None:
        """Make everything of a row zero."""
        self._both[:, :, row, :, : self._reached[row]] = 0
