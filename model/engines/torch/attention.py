"""Attention of one pass over rows of keys and values.

A `PromptPass` writes and reads one prompt. A `DrawPass` feeds all running draws: a draw's token sees its
scene's prompt, which lies in memory once, and what the draw itself has written. The two parts are worked
out apart, the prompt's for all draws of a scene in one product, and joined by their softmax sums
(log-sum-exp merging as in FlashDecoding, https://pytorch.org/blog/flash-decoding/).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from model.engines.torch.kv import KvRows

IntArray = npt.NDArray[np.int64]


class PromptPass:
    """The next ``count`` tokens of the prompt in ``row``, behind ``start`` that are there."""

    def __init__(self, prompts: KvRows, row: int, start: int, count: int) -> None:
        self._prompts, self._row, self._start, self._end = prompts, row, start, start + count
        self._mask: Tensor | None = None
        if start:
            seen = torch.arange(self._end, device=prompts.keys.device)
            self._mask = seen <= seen[start:, None]

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; what ``query`` [t, h, d], scaled, sees: [t, h x d]."""
        keys, values = (memory[layer, self._row] for memory in (self._prompts.keys, self._prompts.values))
        keys[:, self._start : self._end] = key.transpose(0, 1)
        values[:, self._start : self._end] = value.transpose(0, 1)
        attended = functional.scaled_dot_product_attention(
            query.transpose(0, 1)[None],
            keys[None, :, : self._end],
            values[None, :, : self._end],
            attn_mask=self._mask,
            is_causal=self._mask is None,
            scale=1.0,
            enable_gqa=True,
        )
        return attended[0].transpose(0, 1).reshape(len(query), -1)


class Fed(NamedTuple):
    """What one row of a pass brings.

    Attributes:
        prompt: the row of its prompt.
        held: tokens that the draw's row holds before the pass.
        fed: tokens that the pass brings, at least one.
    """

    prompt: int
    held: int
    fed: int


class DrawPass:
    """The next tokens of the first ``len(fed)`` draws, packed row after row.

    Args:
        prompts: keys and values of prompts.
        draws: keys and values of draws.
        fed: one a row.
        prompt_lengths: tokens in each of the first prompts.
    """

    def __init__(
        self, prompts: KvRows, draws: KvRows, fed: Sequence[Fed], prompt_lengths: Sequence[int]
    ) -> None:
        self._prompts, self._draws = prompts, draws
        device = draws.keys.device
        # Sums of many small shares need more digits than bfloat16 has.
        self._exact = torch.promote_types(draws.keys.dtype, torch.float32)
        counts = np.array([row.fed for row in fed])
        held = np.array([row.held for row in fed])
        row_of = np.repeat(np.arange(len(fed)), counts)
        within = np.arange(len(row_of)) - np.repeat(np.cumsum(counts) - counts, counts)
        places = held[row_of] + within
        heads = row_of[:, None] * draws.heads + np.arange(draws.heads)
        self._written = _tensor((heads * draws.length + places[:, None]).ravel(), device)
        self._span = int((held + counts).max())
        self._own = _Padding.of(row_of, within, len(fed), device)
        seen = np.arange(self._span) <= held[:, None, None] + np.arange(self._own.width)[:, None]
        self._own_mask = _additive(seen, self._exact, device)
        prompt_of = np.array([row.prompt for row in fed])[row_of]
        self._prompt_rows = int(prompt_of.max()) + 1
        order = np.argsort(prompt_of, kind="stable")
        sizes = np.bincount(prompt_of, minlength=self._prompt_rows)
        behind = np.empty_like(order)
        behind[order] = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        self._shared = _Padding.of(prompt_of, behind, self._prompt_rows, device)
        lengths = np.array(prompt_lengths[: self._prompt_rows])
        self._prompt_span = int(lengths.max())
        self._shared_mask = None
        if (lengths < self._prompt_span).any():
            # A row whose prompt is not there yet holds zeros; it feeds nothing, so what it sees is no matter.
            seen = np.arange(self._prompt_span) < np.maximum(lengths, 1)[:, None, None]
            self._shared_mask = _additive(seen, self._exact, device)

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; what ``query`` [t, h, d], scaled, sees: [t, h x d]."""
        draws, prompts = self._draws, self._prompts
        width = draws.head_dim
        for memory, new in ((draws.keys, key), (draws.values, value)):
            memory[layer].view(-1, width).index_copy_(0, self._written, new.reshape(-1, width))
        own = self._part(draws, layer, query, self._own, self._span, self._own_mask)
        shared = self._part(prompts, layer, query, self._shared, self._prompt_span, self._shared_mask)
        largest = torch.maximum(own[..., width:-1], shared[..., width:-1])
        own_share = (own[..., width:-1] - largest).exp_()
        shared_share = (shared[..., width:-1] - largest).exp_()
        mixed = own[..., :width] * own_share + shared[..., :width] * shared_share
        mixed /= own[..., -1:] * own_share + shared[..., -1:] * shared_share
        return mixed.flatten(1).to(query.dtype)

    def _part(
        self,
        memory: KvRows,
        layer: int,
        query: Tensor,
        padding: _Padding,
        span: int,
        mask: Tensor | None,
    ) -> Tensor:
        """[t, h, d + 2]: weighted sums of values, largest scores, sums of weights."""
        rows, width, groups = padding.rows, padding.width, memory.heads
        shared_by = query.shape[1] // groups
        asked = padding.pad(query).view(rows, width, groups, shared_by, memory.head_dim)
        asked = asked.transpose(1, 2).reshape(rows * groups, width * shared_by, memory.head_dim)
        keys = memory.keys[layer, :rows, :, :span].flatten(0, 1).transpose(1, 2)
        values = memory.values[layer, :rows, :, :span].flatten(0, 1)
        scores = torch.bmm(asked, keys).to(self._exact)
        if mask is not None:
            scores.view(rows, groups, width, shared_by, span).add_(mask[:, None, :, None])
        largest = scores.amax(dim=-1, keepdim=True)
        weights = scores.sub_(largest).exp_()
        sums = torch.bmm(weights.to(values.dtype), values).to(self._exact)
        parts = torch.cat([sums, largest, weights.sum(dim=-1, keepdim=True)], dim=-1)
        parts = parts.view(rows, groups, width, shared_by, memory.head_dim + 2).transpose(1, 2)
        return padding.unpad(parts.reshape(rows * width, groups * shared_by, -1))


class _Padding(NamedTuple):
    """Between tokens in a packed order and rows of equal width; no indices where both are the same."""

    rows: int
    width: int
    into: Tensor | None
    back: Tensor | None

    @classmethod
    def of(cls, row_of: IntArray, within: IntArray, rows: int, device: torch.device) -> _Padding:
        width = int(within.max()) + 1
        back = row_of * width + within
        if len(back) == rows * width and (back == np.arange(len(back))).all():
            return cls(rows, width, None, None)
        into = np.zeros(rows * width, np.int64)
        into[back] = np.arange(len(back))
        return cls(rows, width, _tensor(into, device), _tensor(back, device))

    def pad(self, packed: Tensor) -> Tensor:
        """[t, ...] -> [rows x width, ...]; empty places repeat the first token."""
        return packed if self.into is None else packed.index_select(0, self.into)

    def unpad(self, padded: Tensor) -> Tensor:
        """[rows x width, ...] -> [t, ...]."""
        return padded if self.back is None else padded.index_select(0, self.back)


def _additive(seen: npt.NDArray[np.bool_], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.zeros(seen.shape, dtype=dtype, device=device).masked_fill_(
        torch.from_numpy(~seen).to(device), float("-inf")
    )


def _tensor(array: IntArray, device: torch.device) -> Tensor:
    return torch.from_numpy(array).to(device)
