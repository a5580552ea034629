"""The one table that owns memory: which KV row a scene has, which slots of it each row has written. No torch.

The draws of a scene walk a tree of tokens. A tree has one KV row: the scene's prompt comes first, then the
tokens of all its draws, each written once, in the first free slot. A row of the batch knows the slots of its
own tokens, in order, and sees those and the prompt. Rows that part share the slots of what they have in
common. Slots of rejected guesses, and of rows that have ended, are simply written over.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class RowInput(NamedTuple):
    """How many tokens a row brings into a pass, and where what it holds lies.

    Attributes:
        entry: of the row, in the slot table.
        kv_row: of its tree.
        prompt_tokens: at the beginning of that.
        held: tokens of the row that are in memory before the pass.
        fed: tokens that the pass brings, at least one.
    """

    entry: int
    kv_row: int
    prompt_tokens: int
    held: int
    fed: int


class SlotMapping(NamedTuple):
    """Where the t tokens of a pass, row after row, are written, and what they see.

    Attributes:
        kv_rows: int64 [t].
        slots: int64 [t], within these.
        seen: bool [t, k]: which of the first k slots of its KV row a token sees, its own among them.
        paths: int64 [held + fed] of each row, the slots of its own tokens in order.
    """

    kv_rows: IntArray
    slots: IntArray
    seen: BoolArray
    paths: Sequence[IntArray]


class Pool:
    """The numbers below ``size``, each used by one at a time; the lowest free one is taken first."""

    def __init__(self, size: int) -> None:
        self._free, self.size = list(range(size)), size

    @property
    def free(self) -> int:
        """How many are free."""
        return len(self._free)

    def take(self) -> int:
        """A number that nobody uses; raises `IndexError` when there is none."""
        return heapq.heappop(self._free)

    def give_back(self, number: int) -> None:
        """``number`` is not used any more."""
        heapq.heappush(self._free, number)


class Memory:
    """The slot table of a decoder.

    Args:
        rows: of the batch.
        row_tokens: that a row holds at most, the prompt apart.
        kv_rows: trees that have memory at once.
        kv_length: slots of a KV row; enough for a prompt and one row of ``row_tokens``.

    Attributes:
        entries: of the table, one a row of the batch.
        kv_rows: of the keys' and values' memory.
    """

    def __init__(self, *, rows: int, row_tokens: int, kv_rows: int, kv_length: int) -> None:
        self.entries, self.kv_rows = Pool(rows), Pool(kv_rows)
        self._length = kv_length
        self._slots = np.zeros((rows, row_tokens), np.int64)
        """[entries, row_tokens]: the slots of each row's tokens, in order."""

    def fork(self, entry: int) -> int:
        """A new entry that knows what ``entry`` knows."""
        new = self.entries.take()
        self._slots[new] = self._slots[entry]
        return new

    def fitting(self, inputs: Sequence[RowInput]) -> int:
        """How many of the first rows of one tree have slots for what they bring, with what these hold."""
        if not inputs or inputs[0].prompt_tokens + sum(row.held + row.fed for row in inputs) <= self._length:
            return len(inputs)
        used = np.zeros(self._length, np.bool_)
        used[: inputs[0].prompt_tokens] = True
        brought = 0
        for number, row in enumerate(inputs):
            used[self._slots[row.entry, : row.held]] = True
            brought += row.fed
            if used.sum() + brought > self._length:
                return number
        return len(inputs)

    def map(self, inputs: Sequence[RowInput]) -> SlotMapping:
        """Assign slots to what rows bring.

        Args:
            inputs: of a tree all rows that hold anything, since the slots of others would count as free;
                `fitting` says whether there are enough.
        """
        entries, kv_rows, prompt_tokens, held, counts = np.array(inputs, np.int64).T
        rows, columns = np.nonzero(np.arange(held.max()) < held[:, None])
        taken = self._slots[entries[rows], columns]
        order = np.argsort(kv_rows, kind="stable")
        firsts = np.flatnonzero(np.diff(kv_rows[order], prepend=-1))
        brought = np.add.reduceat(counts[order], firsts)
        end = max(int(prompt_tokens.max()), int(taken.max(initial=-1)) + 1)
        seen = np.arange(end + int(brought.max())) < prompt_tokens[:, None]
        seen[rows, taken] = True
        used = np.logical_or.reduceat(seen[order], firsts, axis=0)
        free = [np.flatnonzero(~each)[:count] for each, count in zip(used, brought, strict=True)]

        row_of = np.repeat(np.arange(len(inputs)), counts)
        within = count_up(counts)
        slots = np.empty_like(row_of)
        slots[np.argsort(kv_rows[row_of], kind="stable")] = np.concatenate(free)
        self._slots[entries[row_of], held[row_of] + within] = slots
        # Of what the pass brings, a token sees its row's tokens up to itself.
        number = np.arange(len(row_of))
        later, earlier = np.nonzero((row_of[:, None] == row_of) & (number[:, None] >= number))
        seen = seen[row_of, : max(end, int(slots.max()) + 1)]
        seen[later, slots[earlier]] = True
        paths = [self._slots[row.entry, : row.held + row.fed] for row in inputs]
        return SlotMapping(kv_rows[row_of], slots, seen, paths)


def count_up(counts: IntArray) -> IntArray:
    """0, 1, … as often as each of ``counts`` says."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
