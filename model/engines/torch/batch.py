"""What a pass feeds: the tokens of some rows, and where they go. No torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.engines.torch.kv_memory import Memory, RowInput, SlotMapping

if TYPE_CHECKING:
    from looktwice.model.engines.torch.runner import PromptPrefill  # a runner needs torch, batches do not

Ids = npt.NDArray[np.int64]


class Feed(NamedTuple):
    """What a row feeds in a pass.

    Attributes:
        entry: of the row, in the slot table.
        prompt: of its tree.
        held: tokens of the row that are in memory.
        tokens: at least one.
        wanted: positions among the tokens, ascending, and the ids whose logits behind them are asked for.
    """

    entry: int
    prompt: PromptPrefill
    held: int
    tokens: Sequence[int]
    wanted: Sequence[tuple[int, Ids]]

    @property
    def row_input(self) -> RowInput:
        """What the slot table needs to know."""
        return RowInput(self.entry, self.prompt.kv_row, self.prompt.length, self.held, len(self.tokens))


class Batch(NamedTuple):
    """The feeds of a pass with the slots that are assigned to them."""

    feeds: Sequence[Feed]
    mapping: SlotMapping

    @classmethod
    def of(cls, feeds: Sequence[Feed], memory: Memory) -> Batch:
        """Assign slots; see `Memory.map`."""
        return cls(feeds, memory.map([feed.row_input for feed in feeds]))
