"""Attention of one pass over rows of keys and values.

A `PromptPass` writes and reads prompts. A `DrawPass` feeds all running draws: the tokens of all draws of a
scene ask together, over the prompt and everything the scene's draws have written; a mask says whose each
place is. So a prompt's keys and values lie in memory once and are read once for all draws, and what draws
have in common as well (tree attention as in SpecInfer, https://arxiv.org/abs/2305.09781, section 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from model.engines.torch.kv import KvRows
from model.engines.torch.layout import LEAST_QUERIES, InOrder, Part, reached, stretches


class PromptPart(NamedTuple):
    """The next ``fed`` tokens of the prompt in ``row``, behind ``held`` that are there."""

    row: int
    held: int
    fed: int


class PromptsInOrder:
    """The next tokens of some prompts: as `PromptPass`, but what one is told depends on its prompt alone."""

    def __init__(self, memory: KvRows, parts: Sequence[PromptPart]) -> None:
        self._counts = [part.fed for part in parts]
        self._parts = []
        for row, held, fed in parts:
            runs = []
            for start, stop, span in stretches(held, held + fed, memory.length):
                seen = torch.arange(span) <= torch.arange(start, max(stop, start + LEAST_QUERIES))[:, None]
                runs.append((start - held, stop - held, _hiding(seen, memory.flat)))
            self._parts.append((memory.row(row, runs[-1][2].shape[-1]), held, runs))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; what ``query`` [t, h, d], scaled, sees: [t, h x d]."""
        count = sum(self._counts)
        fed = (torch.split(each[:count], self._counts) for each in (query, key, value))
        attended = []
        for (memory, held, runs), asked, *new in zip(self._parts, *fed, strict=True):
            keys, values = memory[:, layer]
            for place, written in zip((keys, values), new, strict=True):
                place[:, held : held + len(asked)] = written.transpose(0, 1)
            for start, stop, mask in runs:
                lacking = mask.shape[0] - (stop - start)
                queries = functional.pad(asked[start:stop].transpose(0, 1), (0, 0, 0, lacking))
                seen = functional.scaled_dot_product_attention(
                    queries[None],
                    keys[None, :, : mask.shape[1]],
                    values[None, :, : mask.shape[1]],
                    attn_mask=mask,
                    scale=1.0,
                    enable_gqa=True,
                )
                attended.append(seen[0, :, : stop - start].transpose(0, 1).reshape(stop - start, -1))
        return functional.pad(torch.cat(attended), (0, 0, 0, len(query) - count))


class PromptPass:
    """The next tokens of some prompts, packed one after the other, padding behind them."""

    def __init__(self, memory: KvRows, parts: Sequence[PromptPart]) -> None:
        self._counts = [part.fed for part in parts]
        self._parts = []
        for row, held, fed in parts:
            held_and_fed = memory.row(row, held + fed)
            seen = torch.arange(held + fed, device=held_and_fed.device)
            self._parts.append((held_and_fed, held, seen <= seen[held:, None] if held else None))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; what ``query`` [t, h, d], scaled, sees: [t, h x d]."""
        count = sum(self._counts)
        fed = (torch.split(each[:count], self._counts) for each in (query, key, value))
        attended = []
        for (memory, held, mask), asked, *new in zip(self._parts, *fed, strict=True):
            keys, values = memory[:, layer]
            for place, written in zip((keys, values), new, strict=True):
                place[:, held:] = written.transpose(0, 1)
            seen = functional.scaled_dot_product_attention(
                asked.transpose(0, 1)[None],
                keys[None],
                values[None],
                attn_mask=mask,
                is_causal=mask is None,
                scale=1.0,
                enable_gqa=True,
            )
            attended.append(seen[0].transpose(0, 1).reshape(len(asked), -1))
        return functional.pad(torch.cat(attended), (0, 0, 0, len(query) - count))


class DrawPass:
    """The next tokens of running draws, packed.

    Args:
        heads: of queries.
        memory: keys and values, one row a scene; it reaches as far as the parts see.
        parts, slots, into, back, hidden: see `Layout`; all but the first where the memory is.
    """

    def __init__(
        self,
        heads: int,
        memory: KvRows,
        parts: Sequence[Part],
        *,
        slots: Tensor,
        into: Tensor,
        back: Tensor,
        hidden: Tensor,
    ) -> None:
        self._memory = memory.reach(*reached(parts))
        self._flat, self._slots, self._into, self._back = memory.flat, slots, into, back
        self._count = len(slots) // memory.heads
        self._asked = [part.rows * part.width * heads for part in parts]
        sizes = [part.rows * part.width * part.span for part in parts]
        self._parts = []
        for part, unseen in zip(parts, torch.split(hidden, sizes), strict=True):
            shape = (part.rows * part.width, heads // memory.heads, part.span)
            mask = torch.zeros(shape, dtype=self._memory.dtype, device=self._memory.device)
            mask.masked_fill_(unseen.view(-1, 1, part.span), float("-inf"))
            self._parts.append((part, mask.view(part.rows, 1, -1, part.span)))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; what ``query`` [t, h, d], scaled, sees: [t, h x d]."""
        keys, values = self._memory[:, layer]
        width = query.shape[-1]
        for place, new in zip(self._flat[:, layer], (key, value), strict=True):
            place.index_copy_(0, self._slots, new[: self._count].reshape(-1, width))
        asked = torch.split(query.reshape(-1, width).index_select(0, self._into), self._asked)
        seen = [
            functional.scaled_dot_product_attention(
                queries.view(part.rows, keys.shape[1], -1, width),
                keys[part.first : part.first + part.rows, :, : part.span],
                values[part.first : part.first + part.rows, :, : part.span],
                attn_mask=mask,
                scale=1.0,
            ).reshape(-1, width)
            for queries, (part, mask) in zip(asked, self._parts, strict=True)
        ]
        return torch.cat(seen).index_select(0, self._back).view(len(query), -1)


class DrawsInOrder:
    """The next tokens of running draws: as `DrawPass`, but what one is told depends on its draw alone.

    Sums of rounded numbers depend on their order. So each row looks by itself, at copies of keys and values
    in the order of its text, and over as many places as its tokens' own places say, whatever else runs.
    """

    def __init__(self, memory: KvRows, layout: InOrder) -> None:
        self._memory = memory
        device = memory.flat.device
        self._slots, self._back = (torch.from_numpy(each).to(device) for each in (layout.slots, layout.back))
        rows, within = np.divmod(layout.slots, memory.heads * memory.length)
        memory.reach(int(rows.max()) + 1, int((within % memory.length).max()) + 1)
        self._askings = []
        for keys, into, seen in layout.askings:
            hidden = _hiding(torch.arange(keys.shape[-1]) < torch.from_numpy(seen)[..., None], memory.flat)
            mask = hidden.repeat_interleave(into.shape[-1], dim=1)[:, None]
            places, queries = (torch.from_numpy(each).to(device).view(-1) for each in (keys, into))
            self._askings.append((keys.shape, places, queries, mask))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; what ``query`` [t, h, d], scaled, sees: [t, h x d]."""
        flat, width = self._memory.flat[:, layer], query.shape[-1]
        count = len(self._slots) // self._memory.heads
        for place, new in zip(flat, (key, value), strict=True):
            place.index_copy_(0, self._slots, new[:count].reshape(-1, width))
        queries, seen = query.reshape(-1, width), []
        for (rows, groups, span), places, into, mask in self._askings:
            keys, values = (
                of.index_select(0, places).view(rows, groups, span, width) for of in flat.unbind()
            )
            asked = queries.index_select(0, into).view(rows, groups, -1, width)
            told = functional.scaled_dot_product_attention(asked, keys, values, attn_mask=mask, scale=1.0)
            seen.append(told.reshape(-1, width))
        return torch.cat(seen).index_select(0, self._back).view(len(query), -1)


def _hiding(seen: Tensor, like: Tensor) -> Tensor:
    """What is added to scores so that only what is seen counts, of the type and on the device of ``like``."""
    mask = torch.zeros(seen.shape, dtype=like.dtype, device=like.device)
    return mask.masked_fill_(~seen.to(like.device), float("-inf"))
