"""Index arrays of a decode pass: where tokens are written, and which queries attend together. No torch.

Shape legend, here and in `attention`:

    t  tokens of a pass, padding included          h  query heads
    g  heads of keys and values                    m  query heads of one of these, h / g
    d  width of a head                             k  tokens of a pass that are no padding

The flat memory of a layer is [KV rows x g x length, d]; the flat queries of a pass are [t x h, d].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from looktwice.model.engines.torch.kv_memory import BoolArray, IntArray, SlotMapping, count_up

_SPAN: Final = 32
"""Slots that are attended to come in multiples of this: few sizes, few kernels."""
_BUCKET_SPAN: Final = 128
"""The same for bucketed passes."""
_ORDERED_SPAN: Final = 128
"""The same where the sums of a token may depend on nothing but its own text."""
MIN_QUERIES: Final = 4
"""Rows of a call, or of a product: for fewer, libraries have kernels that add up in another order."""
_PADDING: Final = 6_000
"""Padding, in slots attended to over all tokens, that takes as long as a call of its own."""


def bucket(count: int) -> int:
    """The bucket of a pass with ``count`` tokens: one of few sizes, at most a quarter too large.

    For every new size of a product in bfloat16 a CPU's library makes a kernel first, which takes as long
    as using it forty times.
    """
    step = 1 << max(0, (count - 1).bit_length() - 3) if count else 1
    return -(-count // step) * step


def repeatable_bucket(count: int) -> int:
    """The bucket of a pass whose tokens must not depend on how many there are.

    Products in float32 add up in another order for fewer rows than four (MKL on AVX2).
    """
    return max(bucket(count), MIN_QUERIES)


class Shape(NamedTuple):
    """Sizes of attention and its memory: h, g, KV rows, and slots in each."""

    heads: int
    kv_heads: int
    rows: int
    length: int


class Part(NamedTuple):
    """Consecutive KV rows that attend in one call: ``rows`` of them, each padded to ``width`` tokens.

    Their queries see the first ``span`` slots.
    """

    first: int
    rows: int
    width: int
    span: int


class Layout(NamedTuple):
    """A pass in which all rows of a tree attend together.

    Within a part queries lie as [row, g, token, m].

    Attributes:
        parts: what attends in one call.
        slot_mapping: int64 [k x g], where keys and values are written in the flat memory.
        query_index: int64 [queries of all parts], each one's place among the flat queries.
        output_index: int64 [t x h], for each flat query its place among those of the parts.
        masked: bool [sum of rows x width x span], the slots that tokens of the parts do not see.
    """

    parts: tuple[Part, ...]
    slot_mapping: IntArray
    query_index: IntArray
    output_index: IntArray
    masked: BoolArray


def compact_layout(shape: Shape, mapping: SlotMapping, size: int) -> Layout:
    """With little padding: trees that bring about as many tokens, and see about as many slots, share a call.

    Args:
        shape: see there.
        mapping: where tokens are written and what they see.
        size: tokens of the pass; those behind the mapped ones are padding, whose output means nothing.
    """
    widths, ends = _extents(mapping)
    parts = []
    for run in _similar(widths, ends):
        width, end = int(widths[run].max()), int(ends[run].max())
        if width:  # else nobody in these KV rows is fed
            parts.append(Part(run.start, run.stop - run.start, width, min(end, shape.length)))
    slots, outputs, queries, masked = _indices(shape, mapping, parts)
    return Layout(tuple(parts), slots.ravel(), queries, padded(outputs, size, "constant").ravel(), masked)


def bucketed_layout(shape: Shape, mapping: SlotMapping, size: int) -> Layout:
    """With few sizes, so that most passes are like one before: all trees share one call.

    Takes what `compact_layout` takes. Padding repeats the last token in everything, so that it writes once
    more what that writes.
    """
    widths, ends = _extents(mapping)
    rows = min(1 << (len(widths) - 1).bit_length(), shape.rows)
    span = min(-(-int(ends.max()) // _BUCKET_SPAN) * _BUCKET_SPAN, shape.length)
    part = Part(0, rows, bucket(int(widths.max())), span)
    slots, outputs, queries, masked = _indices(shape, mapping, [part])
    return Layout(
        (part,), padded(slots, size, "edge").ravel(), queries, padded(outputs, size, "edge").ravel(), masked
    )


class RowPath(NamedTuple):
    """What a row of the batch attends to, in the order of its text.

    Attributes:
        kv_row: of its tree.
        slots: int64 [n], of the prompt's tokens and the row's own.
        fed: how many of the last of them come in the pass.
    """

    kv_row: int
    slots: IntArray
    fed: int


class Span(NamedTuple):
    """Tokens from ``start`` to ``stop`` of a text, which see at most its first ``length`` tokens."""

    start: int
    stop: int
    length: int


class OrderedCall(NamedTuple):
    """Queries that attend in one call, a line for each span of a row.

    Attributes:
        key_index: int64 [lines, g, span length], what a line attends to in the flat memory, in order.
        query_index: int64 [lines, g, width, m], each one's place among the flat queries.
        seen: int64 [lines, width], how many of the first keys a token sees.
    """

    key_index: IntArray
    query_index: IntArray
    seen: IntArray


class OrderedLayout(NamedTuple):
    """A pass in which every row attends by itself, in the order of its text.

    Attributes:
        slot_mapping: int64 [k x g], where keys and values are written in the flat memory.
        calls: in the order of what their queries give.
        output_index: int64 [t x h], for each flat query its place among those of the calls.
    """

    slot_mapping: IntArray
    calls: tuple[OrderedCall, ...]
    output_index: IntArray


def ordered_layout(shape: Shape, paths: Sequence[RowPath], size: int) -> OrderedLayout:
    """A layout in which what a token attends to, and in which order, depends on its own text alone.

    Args:
        shape: see there.
        paths: of the rows that are fed, in their order.
        size: tokens of the pass; those behind the paths' are padding, whose output means nothing.
    """
    heads = np.arange(shape.heads).reshape(shape.kv_heads, -1)  # [g, m]
    members = heads.shape[1]
    kv_head = np.arange(shape.kv_heads)
    alike: dict[tuple[int, int], list[tuple[int, int, Span]]] = {}
    slots, first = [], 0
    for number, (kv_row, path, fed) in enumerate(paths):
        slots.append((kv_row * shape.kv_heads + kv_head) * shape.length + path[-fed:, None])
        begin = len(path) - fed
        for span in spans_of(begin, len(path), shape.length):
            count = max(span.stop - span.start, -(-MIN_QUERIES // members))
            kind = (span.length, 1 << (count - 1).bit_length())
            alike.setdefault(kind, []).append((number, first + span.start - begin, span))
        first += fed
    outputs, calls, before = np.zeros((size, shape.heads), np.int64), [], 0
    for (length, width), lines in sorted(alike.items()):
        keys = np.empty((len(lines), shape.kv_heads, length), np.int64)
        queries = np.zeros((len(lines), shape.kv_heads, width, members), np.int64)
        seen = np.ones((len(lines), width), np.int64)
        for line, (number, token, (start, stop, _)) in enumerate(lines):
            kv_row, path, _ = paths[number]
            known = path[:length]
            keys[line] = (kv_row * shape.kv_heads + kv_head[:, None]) * shape.length
            keys[line, :, : len(known)] += known
            count = stop - start
            tokens = np.arange(token, token + count)
            seen[line, :count] = np.arange(start, stop) + 1
            queries[line, :, :count] = tokens[:, None] * shape.heads + heads[:, None]
            within = (line * shape.kv_heads + kv_head[:, None]) * width * members + np.arange(members)
            outputs[tokens] = before + within.ravel() + np.arange(count)[:, None] * members
        calls.append(OrderedCall(keys, queries, seen))
        before += queries.size
    return OrderedLayout(np.concatenate(slots).ravel(), tuple(calls), outputs.ravel())


def spans_of(start: int, stop: int, length: int) -> list[Span]:
    """The tokens from ``start`` to ``stop`` of a text, by how many of the ``length`` slots they attend to."""
    found = []
    while start < stop:
        end = (start // _ORDERED_SPAN + 1) * _ORDERED_SPAN
        found.append(Span(start, min(stop, end), min(end, length)))
        start = found[-1].stop
    return found


def reached(parts: Sequence[Part]) -> tuple[int, int]:
    """KV rows and slots that parts see."""
    return parts[-1].first + parts[-1].rows, max(part.span for part in parts)


def _extents(mapping: SlotMapping) -> tuple[IntArray, IntArray]:
    """Of each KV row the tokens that it brings, and the end of what they see."""
    brought = np.bincount(mapping.kv_rows)
    last = mapping.seen.shape[1] - mapping.seen[:, ::-1].argmax(axis=1)
    ends = np.full_like(brought, _SPAN)
    np.maximum.at(ends, mapping.kv_rows, -(-last // _SPAN) * _SPAN)
    return brought, ends


def _indices(
    shape: Shape, mapping: SlotMapping, parts: Sequence[Part]
) -> tuple[IntArray, IntArray, IntArray, BoolArray]:
    """`Layout`'s ``slot_mapping`` [k, g], ``output_index`` [k, h], ``query_index`` and ``masked``."""
    kv_rows, seen, count = mapping.kv_rows, mapping.seen, len(mapping.slots)
    slots = kv_rows[:, None] * shape.kv_heads + np.arange(shape.kv_heads)
    slots = slots * shape.length + mapping.slots[:, None]
    order = np.argsort(kv_rows, kind="stable")
    number = np.empty_like(order)  # of a token, among those of its KV row
    number[order] = count_up(np.bincount(kv_rows))
    firsts, rows, widths, _ = np.array(parts).T
    part_of = np.searchsorted(firsts, kv_rows, side="right") - 1
    sizes = rows * widths
    starts = np.cumsum(sizes) - sizes
    width = widths[part_of]
    row = kv_rows - firsts[part_of]
    members = shape.heads // shape.kv_heads
    kv_head, member = np.divmod(np.arange(shape.heads), members)
    outputs = starts[part_of][:, None] * shape.heads + member
    outputs += (((row[:, None] * shape.kv_heads + kv_head) * width[:, None]) + number[:, None]) * members
    queries = np.zeros(int(sizes.sum()) * shape.heads, np.int64)
    queries[outputs] = np.arange(count * shape.heads).reshape(outputs.shape)
    masks = []
    for index, part in enumerate(parts):
        mine = part_of == index
        # Padding sees the first slot: softmax over nothing would be no number.
        masked = np.ones((part.rows * part.width, part.span), np.bool_)
        masked[:, 0] = False
        masked[(row * width + number)[mine], : seen.shape[1]] = ~seen[mine, : part.span]
        masks.append(masked.ravel())
    return slots, outputs, queries, np.concatenate(masks)


def padded(array: IntArray, size: int, mode: Literal["constant", "edge"]) -> IntArray:
    """More rows behind those of ``array``: zeros, or its last one again."""
    return np.pad(array, ((0, size - len(array)), *[(0, 0)] * (array.ndim - 1)), mode=mode)


def _similar(widths: IntArray, ends: IntArray) -> list[slice]:
    """Runs of KV rows that share a call: each brings so many tokens, which see slots up to its end."""
    runs, first, widest, longest = [], 0, int(widths[0]), int(ends[0])
    for row in range(1, len(widths)):
        wider, longer = max(widest, int(widths[row])), max(longest, int(ends[row]))
        joined = (row - first + 1) * wider * longer
        apart = (row - first) * widest * longest + int(widths[row] * ends[row])
        if joined - apart <= _PADDING:
            widest, longest = wider, longer
        else:
            runs.append(slice(first, row))
            first, widest, longest = row, int(widths[row]), int(ends[row])
    return [*runs, slice(first, len(widths))]
