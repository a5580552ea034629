from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from looktwice.model.engines.torch.cached_attention import DecodeAttention
from looktwice.model.engines.torch.kv import KvRows
from looktwice.model.engines.torch.kv_memory import Memory, RowInput, SlotMapping
from looktwice.model.engines.torch.layout import Layout, Part, Shape, bucket, bucketed_layout, compact_layout

PROMPTS = (5, 3, 9)
HEADS, GROUPS, WIDTH = 4, 2, 8


def empty(*, layers: int, rows: int, length: int, dtype: torch.dtype) -> KvRows:
    cpu = torch.device("cpu")
    return KvRows(
        layers=layers, heads=GROUPS, head_dim=WIDTH, rows=rows, length=length, dtype=dtype, device=cpu
    )


def draw_pass(memory: KvRows, arranged: Layout) -> DecodeAttention:
    return DecodeAttention(
        HEADS,
        memory,
        arranged.parts,
        slot_mapping=torch.from_numpy(arranged.slot_mapping),
        query_index=torch.from_numpy(arranged.query_index),
        output_index=torch.from_numpy(arranged.output_index),
        masked=torch.from_numpy(arranged.masked),
    )


def shape(memory: KvRows) -> Shape:
    return Shape(HEADS, GROUPS, memory.rows, memory.length)


def slot_table(rows: int) -> Memory:
    """With entries for so many rows of up to 40 tokens."""
    table = Memory(rows=16, row_tokens=40, kv_rows=16, kv_length=3000)
    for _ in range(rows):
        table.entries.take()
    return table


@pytest.mark.parametrize("arrange", [compact_layout, bucketed_layout])
@pytest.mark.parametrize("seed", range(20))
def test_each_token_sees_its_prompt_and_what_its_draw_has_written(
    seed: int, arrange: Callable[[Shape, SlotMapping, int], Layout]
) -> None:
    """Passes over draws that part and write by chance, against attention worked out draw by draw."""
    random = np.random.default_rng(seed)
    torch.manual_seed(seed)
    memory = empty(layers=2, rows=4, length=200, dtype=torch.float64)
    prompts = [torch.randn(2, 2, GROUPS, length, WIDTH, dtype=torch.float64) for length in PROMPTS]
    for row, prompt in enumerate(prompts):
        memory.row(row, prompt.shape[-2]).copy_(prompt)
    slots, prompt_of = slot_table(4), [0, 2, 2, 1]
    # Keys and values that each draw has written, [2, groups, t, width], in the layer looked at.
    written = [torch.empty(2, GROUPS, 0, WIDTH, dtype=torch.float64) for _ in prompt_of]
    for step in range(6):
        if step == 3:  # the second draw parts in two
            assert slots.fork(1) == 4
            prompt_of.append(2)
            written.append(written[1])
        resting = int(random.integers(-1, 3))  # a prompt whose rows are not fed in this pass
        rows = [row for row, prompt in enumerate(prompt_of) if prompt != resting]
        counts = [int(random.integers(1, 9)) for _ in rows]
        fed = [
            RowInput(row, prompt_of[row], PROMPTS[prompt_of[row]], written[row].shape[2], count)
            for row, count in zip(rows, counts, strict=True)
        ]
        total = sum(counts)
        size = bucket(total) + 1
        query = torch.randn(size, HEADS, WIDTH, dtype=torch.float64)
        key, value = (torch.randn(size, GROUPS, WIDTH, dtype=torch.float64) for _ in range(2))
        for each in (query, key, value):  # as the runner pads
            each[total:] = each[total - 1]
        attention = draw_pass(memory, arrange(shape(memory), slots.map(fed), size))
        seen = attention.attend(1, query, key, value)
        start = 0
        for row, count in zip(rows, counts, strict=True):
            new = torch.stack([key, value])[:, start : start + count].transpose(1, 2)
            everything = torch.cat([prompts[prompt_of[row]][:, 1], written[row], new], dim=2)
            before = everything.shape[2] - count
            for place in range(count):
                keys, values = everything[:, :, : before + place + 1].repeat_interleave(HEADS // GROUPS, 1)
                asked = query[start + place][:, None]
                expected = torch.softmax(asked @ keys.transpose(1, 2), -1) @ values
                torch.testing.assert_close(seen[start + place].view(HEADS, 1, WIDTH), expected)
            # Of what was fed, a row may keep a part only.
            kept = before - PROMPTS[prompt_of[row]] + int(random.integers(0, count + 1))
            written[row] = everything[:, :, PROMPTS[prompt_of[row]] :][:, :, :kept]
            start += count


def test_a_scene_that_sees_far_leaves_the_others_their_span() -> None:
    memory = empty(layers=1, rows=3, length=3000, dtype=torch.float32)
    lengths = (20, 2000, 30)
    mapping = slot_table(3).map([RowInput(row, row, lengths[row], 0, 8) for row in range(3)])
    assert [part.span for part in compact_layout(shape(memory), mapping, 24).parts] == [32, 2016, 64]


def test_passes_are_alike_while_they_are_small() -> None:
    memory = empty(layers=1, rows=16, length=3000, dtype=torch.float32)
    parts = set()
    for rows in (5, 6, 7, 8):
        table = slot_table(rows)
        for fed in range(10):
            mapping = table.map([RowInput(row, row, 70, fed, 1) for row in range(rows)])
            parts.add(bucketed_layout(shape(memory), mapping, bucket(rows)).parts)
    assert parts == {(Part(0, 8, 1, 128),)}


def test_passes_have_few_sizes_and_little_padding() -> None:
    sizes = [bucket(count) for count in range(1, 2001)]
    assert all(count <= size <= 1.25 * count for count, size in enumerate(sizes, start=1))
    assert sizes[:8] == list(range(1, 9))
    assert len(set(sizes)) < 50
