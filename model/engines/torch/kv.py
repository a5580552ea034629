"""Keys and values in rows: one row a prompt or a draw, the live rows always the first ones."""

from __future__ import annotations

import torch


class KvRows:
    """Preallocated keys and values, [layers, rows, heads, length, head_dim] each.

    Live rows come first, so that a pass over all of them reads views instead of gathering copies.
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
        # Zeros, not garbage: masked positions are multiplied by zero weights, and 0 x NaN would be NaN.
        self.both = torch.zeros((2, layers, rows, heads, length, head_dim), dtype=dtype, device=device)
        self.keys, self.values = self.both.unbind()
        self.rows, self.heads, self.length, self.head_dim = rows, heads, length, head_dim

    def copy(self, source: int, target: int, length: int) -> None:
        """Make row ``target`` hold what row ``source`` holds in its first ``length`` places."""
        self.both[:, :, target, :, :length] = self.both[:, :, source, :, :length]
