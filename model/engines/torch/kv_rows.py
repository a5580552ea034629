"""Keys and values of running draws: one row a draw, the live rows always the first ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


class KvRows:
    """Preallocated keys and values, [layers, rows, heads, length, head_dim].

    The last position of every row is scratch: padding of a step is written there and never read.
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
        shape = (layers, rows, heads, length + 1, head_dim)
        # Zeros, not garbage: masked positions are multiplied by zero weights, and 0 x NaN would be NaN.
        self._keys = torch.zeros(shape, dtype=dtype, device=device)
        self._values = torch.zeros(shape, dtype=dtype, device=device)
        self.rows, self.length = rows, length

    def copy(self, source: int, target: int, length: int) -> None:
        """Make row ``target`` hold what row ``source`` holds in its first ``length`` positions."""
        for memory in (self._keys, self._values):
            memory[:, target, :, :length] = memory[:, source, :, :length]

    def step(self, first_row: int, lengths: Tensor, positions: Tensor) -> KvStep:
        """What attention needs for one pass over consecutive rows.

        Args:
            first_row: the first of the rows.
            lengths: int64 [r], tokens each row will hold after the pass.
            positions: int64 [r, t], where each new token goes; -1 for padding.
        """
        span = int(lengths.max())
        padding = positions < 0
        reach = positions.masked_fill(padding, 0)
        mask = torch.arange(span, device=positions.device) <= reach[..., None]
        return KvStep(
            self._keys[:, first_row : first_row + len(lengths)],
            self._values[:, first_row : first_row + len(lengths)],
            positions.masked_fill(padding, self.length),
            span,
            mask[:, None],
        )


@dataclass(frozen=True)
class KvStep:
    """Stands where `transformers` expects a cache: writes new keys and values, returns all of them.

    Attributes:
        mask: bool [r, 1, t, span], True where a new token may look.
    """

    keys: Tensor
    values: Tensor
    positions: Tensor
    span: int
    mask: Tensor

    def update(self, key_states: Tensor, value_states: Tensor, layer_idx: int) -> tuple[Tensor, Tensor]:
        """Store [r, heads, t, head_dim] and return [r, heads, span, head_dim] of keys and values."""
        rows = torch.arange(len(self.positions), device=self.positions.device)[:, None]
        for memory, new in ((self.keys, key_states), (self.values, value_states)):
            memory[layer_idx][rows, :, self.positions] = new.transpose(1, 2).to(memory.dtype)
        return self.keys[layer_idx][:, :, : self.span], self.values[layer_idx][:, :, : self.span]
