"""Attention of one pass over rows of keys and values.

A `PromptPass` writes and reads prompts. A `DrawPass` feeds all running draws: the tokens of all draws of a
scene ask together, over the prompt and everything the scene's draws have written; a mask says whose each
place is. So a prompt's keys and values lie in memory once and are read once for all draws, and what draws
have in common as well (tree attention as in SpecInfer, https://arxiv.org/abs/2305.09781, section 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from model.engines.torch.kv import KvRows
from model.engines.torch.places import IntArray, Written, count_up

_SPAN: Final = 32
"""Places seen are a multiple of this: few sizes, few kernels."""
_PADDING: Final = 6_000
"""Places looked at in vain, over all tokens, that take as long as a call of its own."""


class PromptPart(NamedTuple):
    """The next ``fed`` tokens of the prompt in ``row``, behind ``held`` that are there."""

    row: int
    held: int
    fed: int


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

    Scenes that bring about as many tokens and see about as many places ask together, padded to the most;
    others in a call of their own.

    Args:
        heads: of queries; keys and values have as many or fewer.
        memory: keys and values, one row a scene.
        written: where the tokens go and what they see.
        size: tokens of the pass; those behind what is written are padding, and nothing becomes of them.
    """

    def __init__(self, heads: int, memory: KvRows, written: Written, size: int) -> None:
        prompts, places, seen = written
        groups, count = memory.heads, len(places)
        brought = np.bincount(prompts)
        last = seen.shape[1] - seen[:, ::-1].argmax(axis=1)
        ends = np.full_like(brought, _SPAN)
        np.maximum.at(ends, prompts, -(-last // _SPAN) * _SPAN)
        self._memory = memory.reach(len(brought), int(ends.max()))
        self._flat, self._count = memory.flat, count
        device = self._memory.device
        slots = (prompts[:, None] * groups + np.arange(groups)) * memory.length + places[:, None]
        self._slots = _tensor(slots, device)

        order = np.argsort(prompts, kind="stable")
        number = np.empty_like(order)
        number[order] = count_up(brought)
        together = _together(brought, ends)
        widths = np.array([brought[part].max() for part in together])
        spans = [int(ends[part].max()) for part in together]
        rows = np.array([part.stop - part.start for part in together])
        part_of = np.repeat(np.arange(len(together)), rows)
        sizes = rows * widths
        starts = np.cumsum(sizes) - sizes
        first, width = starts[part_of][prompts], widths[part_of][prompts]
        row = prompts - np.array([part.start for part in together])[part_of][prompts]

        # Of a part, queries lie as [row, group, token, head of the group].
        group, member = np.divmod(np.arange(heads), heads // groups)
        back = first[:, None] * heads + member
        back += (((row[:, None] * groups + group) * width[:, None]) + number[:, None]) * (heads // groups)
        into = np.zeros(int(sizes.sum()) * heads, np.int64)
        into[back] = np.arange(count * heads).reshape(back.shape)
        self._into = _tensor(into, device)
        self._back = _tensor(np.pad(back, ((0, size - count), (0, 0))), device)
        self._asked = (sizes * heads).tolist()
        place, part = row * width + number, part_of[prompts]
        self._parts = []
        for index, (scenes, span) in enumerate(zip(together, spans, strict=True)):
            mine = part == index
            # Where nobody asks, the first place is seen: softmax over nothing would be no number.
            hidden = np.ones((sizes[index], 1, span), np.bool_)
            hidden[:, 0, 0] = False
            hidden[place[mine], 0, : seen.shape[1]] = ~seen[mine, :span]
            mask = torch.zeros((sizes[index], heads // groups, span), dtype=self._memory.dtype, device=device)
            mask.masked_fill_(torch.from_numpy(hidden).to(device), float("-inf"))
            self._parts.append((scenes, mask.view(scenes.stop - scenes.start, 1, -1, span)))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; what ``query`` [t, h, d], scaled, sees: [t, h x d]."""
        keys, values = self._memory[:, layer]
        width = query.shape[-1]
        for place, new in zip(self._flat[:, layer], (key, value), strict=True):
            place.index_copy_(0, self._slots, new[: self._count].reshape(-1, width))
        asked = torch.split(query.reshape(-1, width).index_select(0, self._into), self._asked)
        seen = [
            functional.scaled_dot_product_attention(
                queries.view(part.stop - part.start, keys.shape[1], -1, width),
                keys[part, :, : mask.shape[-1]],
                values[part, :, : mask.shape[-1]],
                attn_mask=mask,
                scale=1.0,
            ).reshape(-1, width)
            for queries, (part, mask) in zip(asked, self._parts, strict=True)
        ]
        return torch.cat(seen).index_select(0, self._back).view(len(query), -1)


def _together(brought: IntArray, ends: IntArray) -> list[slice]:
    """Runs of rows that ask in one call: row i brings so many tokens that see places up to its end."""
    parts, first, widest, longest = [], 0, int(brought[0]), int(ends[0])
    for row in range(1, len(brought)):
        wider, longer = max(widest, int(brought[row])), max(longest, int(ends[row]))
        joined = (row - first + 1) * wider * longer
        apart = (row - first) * widest * longest + int(brought[row] * ends[row])
        if joined - apart <= _PADDING:
            widest, longest = wider, longer
        else:
            parts.append(slice(first, row))
            first, widest, longest = row, int(brought[row]), int(ends[row])
    return [*parts, slice(first, len(brought))]


def _tensor(array: IntArray, device: torch.device) -> Tensor:
    return torch.from_numpy(array.ravel()).to(device)
