"""Attention of one pass over rows of keys and values.

A `PromptPass` writes and reads prompts. A `DrawPass` feeds all running draws: a draw's token sees its
scene's prompt, which lies in memory once, and what the draw itself has written. The two parts are worked
out apart, the prompt's for all draws of a scene at once, and joined by the sums of their softmaxes
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


class PromptPart(NamedTuple):
    """The next ``fed`` tokens of the prompt in ``row``, behind ``held`` that are there."""

    row: int
    held: int
    fed: int


class PromptPass:
    """The next tokens of some prompts, packed one after the other, padding behind them."""

    def __init__(self, prompts: KvRows, parts: Sequence[PromptPart]) -> None:
        self._prompts, self._parts = prompts, parts
        self._masks = []
        for _, held, fed in parts:
            seen = torch.arange(held + fed, device=prompts.keys.device)
            self._masks.append(seen <= seen[held:, None] if held else None)

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; what ``query`` [t, h, d], scaled, sees: [t, h x d]."""
        counts = [part.fed for part in self._parts]
        fed = (torch.split(each[: sum(counts)], counts) for each in (query, key, value))
        every = zip(self._parts, self._masks, *fed, strict=True)
        attended = torch.cat([self._attend(layer, *each) for each in every])
        return functional.pad(attended, (0, 0, 0, len(query) - sum(counts)))

    def _attend(
        self, layer: int, part: PromptPart, mask: Tensor | None, query: Tensor, key: Tensor, value: Tensor
    ) -> Tensor:
        keys, values = (memory[layer, part.row] for memory in (self._prompts.keys, self._prompts.values))
        end = part.held + part.fed
        keys[:, part.held : end] = key.transpose(0, 1)
        values[:, part.held : end] = value.transpose(0, 1)
        attended = functional.scaled_dot_product_attention(
            query.transpose(0, 1)[None],
            keys[None, :, :end],
            values[None, :, :end],
            attn_mask=mask,
            is_causal=mask is None,
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
        heads: of queries; keys and values have as many or fewer.
        prompts: keys and values of prompts.
        draws: keys and values of draws.
        fed: one a row.
        prompt_lengths: tokens in each of the first prompts.
        size: tokens of the pass; those behind what is fed are padding, and nothing becomes of them.
    """

    def __init__(
        self,
        heads: int,
        prompts: KvRows,
        draws: KvRows,
        fed: Sequence[Fed],
        prompt_lengths: Sequence[int],
        size: int,
    ) -> None:
        self._prompts, self._draws = prompts, draws
        device, groups = draws.keys.device, draws.heads
        counts = np.array([row.fed for row in fed])
        held = np.array([row.held for row in fed])
        row_of = np.repeat(np.arange(len(fed)), counts)
        within = _count_up(counts)
        places = held[row_of] + within
        slots = (row_of[:, None] * groups + np.arange(groups)) * draws.length + places[:, None]
        self._written = _tensor(slots.ravel(), device)
        self._span = int((held + counts).max())
        self._fed = len(row_of)
        self._own = _Grouping.of(row_of, within, size, heads, groups, device)
        seen = np.arange(self._span) <= held[:, None, None] + np.arange(self._own.width)[:, None]
        self._own_mask = _additive(seen.repeat(heads // groups, axis=1), draws.keys)
        prompt_of = np.array([row.prompt for row in fed])[row_of]
        order = np.argsort(prompt_of, kind="stable")
        behind = np.empty_like(order)
        behind[order] = _count_up(np.bincount(prompt_of))
        self._shared = _Grouping.of(prompt_of, behind, size, heads, groups, device)
        lengths = np.array(prompt_lengths[: self._shared.rows])
        self._prompt_span = int(lengths.max())
        self._shared_mask = None
        if (lengths < self._prompt_span).any():
            # A row whose prompt is not there yet holds zeros; it feeds nothing, so what it sees is no matter.
            seen = np.arange(self._prompt_span) < np.maximum(lengths, 1)[:, None, None]
            self._shared_mask = _additive(seen, draws.keys)

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Store ``key`` and ``value`` [t, g, d]; what ``query`` [t, h, d], scaled, sees: [t, h x d]."""
        draws, prompts = self._draws, self._prompts
        width = draws.head_dim
        for memory, new in ((draws.keys, key), (draws.values, value)):
            memory[layer].view(-1, width).index_copy_(0, self._written, new[: self._fed].reshape(-1, width))
        flat = query.reshape(-1, width)
        own, own_sums = self._own.attend(draws, layer, flat, self._span, self._own_mask)
        shared, shared_sums = self._shared.attend(prompts, layer, flat, self._prompt_span, self._shared_mask)
        share = own_sums.sub_(shared_sums).sigmoid_().to(own.dtype)
        return shared.lerp_(own, share[:, None]).view(len(query), -1)


class _Grouping(NamedTuple):
    """Packed tokens as rows of equal width, all heads that share keys side by side.

    Attributes:
        rows, width: of tokens; empty places repeat the first token.
        into: places in queries [t x h, d] of what is asked [rows x groups x width x heads a group, d].
        back: places in the answers to that of [t x h, d].
        back_of_sums: the same in their sums [rows x width x heads a group x groups].
    """

    rows: int
    width: int
    into: Tensor
    back: Tensor
    back_of_sums: Tensor

    @classmethod
    def of(
        cls, row_of: IntArray, within: IntArray, size: int, heads: int, groups: int, device: torch.device
    ) -> _Grouping:
        rows, width, shared_by = int(row_of.max()) + 1, int(within.max()) + 1, heads // groups
        group, member = np.divmod(np.arange(heads), shared_by)
        row, place = row_of[:, None], within[:, None]
        back = ((row * groups + group) * width + place) * shared_by + member
        into = np.zeros(rows * groups * width * shared_by, np.int64)
        into[back] = np.arange(len(row_of) * heads).reshape(back.shape)
        back_of_sums = ((row * width + place) * shared_by + member) * groups + group
        padding = ((0, size - len(row_of)), (0, 0))
        indices = (into, np.pad(back, padding), np.pad(back_of_sums, padding))
        return cls(rows, width, *(_tensor(each.ravel(), device) for each in indices))

    def attend(
        self, memory: KvRows, layer: int, query: Tensor, span: int, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """What queries [t x h, d] see, [t x h, d], and the logarithms of its softmax sums, [t x h]."""
        width = memory.head_dim
        asked = query.index_select(0, self.into).view(self.rows, memory.heads, -1, width)
        keys, values = (part[layer, : self.rows, :, :span] for part in (memory.keys, memory.values))
        seen, sums = attention_with_sums(asked, keys, values, mask)
        return (
            seen.reshape(-1, width).index_select(0, self.back),
            sums.transpose(1, 2).reshape(-1).index_select(0, self.back_of_sums),
        )


def attention_with_sums(
    query: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Attention [r, g, q, d] over keys and values [r, g, k, d], and log-sum-exp of its scores [r, g, q].

    ``mask`` is added to the scores. CPUs have a fused kernel that gives the sums as well.
    """
    if query.device.type == "cpu":
        seen, sums = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu(
            query, keys, values, 0.0, False, attn_mask=mask, scale=1.0
        )
        return seen, sums
    return plain_attention_with_sums(query, keys, values, mask)


def plain_attention_with_sums(
    query: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """`attention_with_sums` in plain operations, for any device."""
    # Sums of many small shares need more digits than bfloat16 has.
    scores = (query @ keys.transpose(-1, -2)).to(torch.promote_types(query.dtype, torch.float32))
    if mask is not None:
        scores += mask
    sums = scores.logsumexp(dim=-1, keepdim=True)
    return scores.sub_(sums).exp_().to(values.dtype) @ values, sums[..., 0]


def _count_up(counts: IntArray) -> IntArray:
    """0, 1, … as often as each of ``counts`` says."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


def _additive(seen: npt.NDArray[np.bool_], like: Tensor) -> Tensor:
    """[r, 1, q, k] of zeros where ``seen`` [r, q, k], minus infinity elsewhere."""
    mask = torch.zeros(seen.shape, dtype=torch.promote_types(like.dtype, torch.float32), device=like.device)
    return mask.masked_fill_(torch.from_numpy(~seen).to(like.device), float("-inf"))[:, None]


def _tensor(array: IntArray, device: torch.device) -> Tensor:
    return torch.from_numpy(array).to(device)
