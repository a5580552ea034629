"""Where draws have written: a scene's prompt and all its draws share one row of keys and values. No torch.

The draws of a scene walk a tree of tokens. Each token is written once, in the first free place behind the
prompt; a draw knows the places of its own tokens, in order, and sees those and the prompt. Draws that part
share the places of what they have in common, and what was fed in vain is simply written over.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Fed(NamedTuple):
    """What one draw's row brings into a pass.

    Attributes:
        row: which it is, of the draws'.
        prompt: the row of its prompt.
        held: tokens that the draw's row holds before the pass.
        fed: tokens that the pass brings, at least one.
    """

    row: int
    prompt: int
    held: int
    fed: int


class Written(NamedTuple):
    """Where the t tokens of a pass, row after row, go, and what they see.

    Attributes:
        prompts: int64 [t], the rows of their prompts.
        places: int64 [t], in these.
        seen: bool [t, k]: which of the first places of its prompt's row a token sees, its own among them.
    """

    prompts: IntArray
    places: IntArray
    seen: BoolArray


class Places:
    """The books of ``rows`` draws with up to ``length`` tokens each."""

    def __init__(self, rows: int, length: int) -> None:
        self._places = np.zeros((rows, length), np.int64)

    def copy(self, source: int, target: int) -> None:
        """Make row ``target`` know the places that row ``source`` knows."""
        self._places[target] = self._places[source]

    def path(self, row: int, count: int) -> IntArray:
        """The places of a row's first ``count`` tokens, in order."""
        return self._places[row, :count]

    def write(self, fed: Sequence[Fed], prompt_lengths: Sequence[int]) -> Written:
        """Find places for what some rows bring.

        Args:
            fed: one a row; of a prompt's rows all or none, since what others have written would be free.
            prompt_lengths: tokens of the prompt in each of the prompts' rows.
        """
        own, prompts, held, counts = (np.array(column, np.int64) for column in zip(*fed, strict=True))
        lengths = np.array(prompt_lengths, np.int64)[prompts]
        rows, columns = np.nonzero(np.arange(held.max()) < held[:, None])
        taken = self._places[own[rows], columns]
        order = np.argsort(prompts, kind="stable")
        firsts = np.flatnonzero(np.diff(prompts[order], prepend=-1))
        brought = np.add.reduceat(counts[order], firsts)
        end = max(int(lengths.max()), int(taken.max(initial=-1)) + 1)
        seen = np.arange(end + int(brought.max())) < lengths[:, None]
        seen[rows, taken] = True
        used = np.logical_or.reduceat(seen[order], firsts, axis=0)
        free = [np.flatnonzero(~each)[:count] for each, count in zip(used, brought, strict=True)]

        row_of = np.repeat(np.arange(len(fed)), counts)
        within = count_up(counts)
        places = np.empty_like(row_of)
        places[np.argsort(prompts[row_of], kind="stable")] = np.concatenate(free)
        self._places[own[row_of], held[row_of] + within] = places
        # Of what the pass brings, a token sees its row's tokens up to itself.
        number = np.arange(len(row_of))
        later, earlier = np.nonzero((row_of[:, None] == row_of) & (number[:, None] >= number))
        seen = seen[row_of, : max(end, int(places.max()) + 1)]
        seen[later, places[earlier]] = True
        return Written(prompts[row_of], places, seen)


def count_up(counts: IntArray) -> IntArray:
    """0, 1, … as often as each of ``counts`` says."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
