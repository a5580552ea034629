"""Attention of one pass over rows of keys and values; `layout` has the shape legend.

Prefill writes and reads prompts. Decoding feeds all running rows. By default the rows of a tree attend
together, over the prompt and everything that the tree has written; a mask says which slots a token sees. So a
prompt's keys and values lie in memory once and are read once for all rows, and what rows have in common as
well (tree attention as in SpecInfer, https://arxiv.org/abs/2305.09781, section 4.2). Where sums must not
depend on what else runs, the ordered classes are used instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from looktwice.model.engines.torch.kv import KvRows
from looktwice.model.engines.torch.layout import MIN_QUERIES, OrderedLayout, Part, reached, spans_of


class PrefillChunk(NamedTuple):
    """The next ``fed`` tokens of the prompt in ``kv_row``, behind ``held`` that are there."""

    kv_row: int
    held: int
    fed: int


class PrefillAttention:
    """The next tokens of some prompts, packed one after the other, padding behind them."""

    def __init__(self, memory: KvRows, chunks: Sequence[PrefillChunk]) -> None:
        self._counts = [chunk.fed for chunk in chunks]
        self._chunks = []
        for kv_row, held, fed in chunks:
            row = memory.row(kv_row, held + fed)  # [2, layers, g, held + fed, d]
            position = torch.arange(held + fed, device=row.device)
            self._chunks.append((row, held, position <= position[held:, None] if held else None))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; the output of ``query`` [t, h, d], scaled: [t, h x d]."""
        count = sum(self._counts)
        fed = (torch.split(each[:count], self._counts) for each in (query, key, value))
        outputs = []
        for (row, held, mask), queries, *new in zip(self._chunks, *fed, strict=True):
            keys, values = row[:, layer]  # [g, held + fed, d]
            for memory, written in zip((keys, values), new, strict=True):
                memory[:, held:] = written.transpose(0, 1)
            output = functional.scaled_dot_product_attention(
                queries.transpose(0, 1)[None],  # [1, h, fed, d]
                keys[None],
                values[None],
                attn_mask=mask,
                is_causal=mask is None,
                scale=1.0,
                enable_gqa=True,
            )
            outputs.append(output[0].transpose(0, 1).reshape(len(queries), -1))
        return functional.pad(torch.cat(outputs), (0, 0, 0, len(query) - count))


class OrderedPrefill:
    """As `PrefillAttention`, but every sum of a token depends on its prompt alone, however it is chunked."""

    def __init__(self, memory: KvRows, chunks: Sequence[PrefillChunk]) -> None:
        self._counts = [chunk.fed for chunk in chunks]
        self._chunks = []
        for kv_row, held, fed in chunks:
            spans = []
            for start, stop, length in spans_of(held, held + fed, memory.length):
                queries = torch.arange(start, max(stop, start + MIN_QUERIES))[:, None]
                spans.append((start - held, stop - held, _mask(torch.arange(length) <= queries, memory.flat)))
            self._chunks.append((memory.row(kv_row, spans[-1][2].shape[-1]), held, spans))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; the output of ``query`` [t, h, d], scaled: [t, h x d]."""
        count = sum(self._counts)
        fed = (torch.split(each[:count], self._counts) for each in (query, key, value))
        outputs = []
        for (row, held, spans), queries, *new in zip(self._chunks, *fed, strict=True):
            keys, values = row[:, layer]  # [g, slots, d]
            for memory, written in zip((keys, values), new, strict=True):
                memory[:, held : held + len(queries)] = written.transpose(0, 1)
            for start, stop, mask in spans:
                lacking = mask.shape[0] - (stop - start)
                some = functional.pad(queries[start:stop].transpose(0, 1), (0, 0, 0, lacking))
                output = functional.scaled_dot_product_attention(
                    some[None],
                    keys[None, :, : mask.shape[1]],
                    values[None, :, : mask.shape[1]],
                    attn_mask=mask,
                    scale=1.0,
                    enable_gqa=True,
                )
                outputs.append(output[0, :, : stop - start].transpose(0, 1).reshape(stop - start, -1))
        return functional.pad(torch.cat(outputs), (0, 0, 0, len(query) - count))


class DecodeAttention:
    """The next tokens of running rows, packed; the rows of a tree attend together.

    Args:
        heads: of queries.
        memory: keys and values; it reaches as far as the parts see.
        parts, slot_mapping, query_index, output_index, masked: see `Layout`; all but the first where the
            memory is.
    """

    def __init__(
        self,
        heads: int,
        memory: KvRows,
        parts: Sequence[Part],
        *,
        slot_mapping: Tensor,
        query_index: Tensor,
        output_index: Tensor,
        masked: Tensor,
    ) -> None:
        self._rows = memory.reach(*reached(parts))  # [2, layers, KV rows, g, slots, d]
        self._flat, self._slot_mapping = memory.flat, slot_mapping
        self._query_index, self._output_index = query_index, output_index
        self._written = len(slot_mapping) // memory.heads
        self._sizes = [part.rows * part.width * heads for part in parts]
        self._parts = []
        sizes = [part.rows * part.width * part.span for part in parts]
        for part, unseen in zip(parts, torch.split(masked, sizes), strict=True):
            shape = (part.rows * part.width, heads // memory.heads, part.span)
            mask = torch.zeros(shape, dtype=self._rows.dtype, device=self._rows.device)
            mask.masked_fill_(unseen.view(-1, 1, part.span), float("-inf"))
            self._parts.append((part, mask.view(part.rows, 1, -1, part.span)))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; the output of ``query`` [t, h, d], scaled: [t, h x d]."""
        keys, values = self._rows[:, layer]  # [KV rows, g, slots, d]
        width = query.shape[-1]
        for memory, new in zip(self._flat[:, layer], (key, value), strict=True):
            memory.index_copy_(0, self._slot_mapping, new[: self._written].reshape(-1, width))
        queries = query.reshape(-1, width).index_select(0, self._query_index)
        outputs = [
            functional.scaled_dot_product_attention(
                some.view(part.rows, keys.shape[1], -1, width),  # [rows, g, width x m, d]
                keys[part.first : part.first + part.rows, :, : part.span],
                values[part.first : part.first + part.rows, :, : part.span],
                attn_mask=mask,
                scale=1.0,
            ).reshape(-1, width)
            for some, (part, mask) in zip(torch.split(queries, self._sizes), self._parts, strict=True)
        ]
        return torch.cat(outputs).index_select(0, self._output_index).view(len(query), -1)


class OrderedDecode:
    """As `DecodeAttention`, but every sum of a token depends on its draw alone.

    Sums of rounded numbers depend on their order. So each row attends by itself, to copies of keys and values
    in the order of its text, and over as many slots as its tokens' own positions say, whatever else runs.
    """

    def __init__(self, memory: KvRows, layout: OrderedLayout) -> None:
        self._memory = memory
        device = memory.flat.device
        self._slot_mapping, self._output_index = (
            torch.from_numpy(each).to(device) for each in (layout.slot_mapping, layout.output_index)
        )
        rows, within = np.divmod(layout.slot_mapping, memory.heads * memory.length)
        memory.reach(int(rows.max()) + 1, int((within % memory.length).max()) + 1)
        self._calls = []
        for key_index, query_index, seen in layout.calls:
            mask = _mask(
                torch.arange(key_index.shape[-1]) < torch.from_numpy(seen)[..., None], memory.flat
            )  # [lines, width, span]
            mask = mask.repeat_interleave(query_index.shape[-1], dim=1)[:, None]
            keys, queries = (torch.from_numpy(each).to(device).view(-1) for each in (key_index, query_index))
            self._calls.append((key_index.shape, keys, queries, mask))

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; the output of ``query`` [t, h, d], scaled: [t, h x d]."""
        flat, width = self._memory.flat[:, layer], query.shape[-1]
        written = len(self._slot_mapping) // self._memory.heads
        for memory, new in zip(flat, (key, value), strict=True):
            memory.index_copy_(0, self._slot_mapping, new[:written].reshape(-1, width))
        queries, outputs = query.reshape(-1, width), []
        for (lines, kv_heads, span), key_index, query_index, mask in self._calls:
            # One by one: along the first dimension rows are copied whole, along the second number by number.
            keys, values = (
                memory.index_select(0, key_index).view(lines, kv_heads, span, width) for memory in flat
            )
            some = queries.index_select(0, query_index).view(lines, kv_heads, -1, width)
            output = functional.scaled_dot_product_attention(some, keys, values, attn_mask=mask, scale=1.0)
            outputs.append(output.reshape(-1, width))
        return torch.cat(outputs).index_select(0, self._output_index).view(len(query), -1)


def _mask(seen: Tensor, like: Tensor) -> Tensor:
    """What is added to scores so that only what is seen counts, of the type and on the device of ``like``."""
    mask = torch.zeros(seen.shape, dtype=like.dtype, device=like.device)
    return mask.masked_fill_(~seen.to(like.device), float("-inf"))
