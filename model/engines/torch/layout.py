"""How the tokens of a pass are brought together for attention. No torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from model.engines.torch.memory import BoolArray, IntArray, SlotMapping, count_up

_SPAN: Final = 32
"""Places seen are a multiple of this: few sizes, few kernels."""
_LONG_SPAN: Final = 128
"""The same for passes that are to be alike."""
_STRETCH: Final = 128
"""The same where what a token is told may depend on nothing but its draw: a step in what it looks at."""
LEAST_QUERIES: Final = 4
"""Of a call: for fewer, libraries have kernels that add up in another order."""
_PADDING: Final = 6_000
"""Places looked at in vain, over all tokens, that take as long as a call of its own."""


def pass_size(count: int) -> int:
    """Tokens that a pass with ``count`` of them is padded to: one of few sizes, at most a quarter too large.

    For every new size of a product in bfloat16 a CPU's library makes a kernel first, which takes as long
    as using it forty times.
    """
    step = 1 << max(0, (count - 1).bit_length() - 3) if count else 1
    return -(-count // step) * step


class Shape(NamedTuple):
    """Of attention and its memory: heads of queries, heads of keys and values, rows, places in each."""

    heads: int
    groups: int
    rows: int
    length: int


class Part(NamedTuple):
    """Scenes that ask together: ``rows`` of them, each padded to ``width`` tokens that see ``span``."""

    first: int
    rows: int
    width: int
    span: int


class Layout(NamedTuple):
    """Where the tokens of a pass go and how they ask, in numbers.

    Of a part, queries lie as [row, group, token, head of the group].

    Attributes:
        parts: scenes that ask together.
        slots: int64, in the flat memory: of k tokens, one for each head of keys and values.
        into: int64, for every query of the parts which of those of the pass [t x h] it is.
        back: int64 [t x h], the other way round.
        hidden: bool, for every token of the parts which places it does not see.
    """

    parts: tuple[Part, ...]
    slots: IntArray
    into: IntArray
    back: IntArray
    hidden: BoolArray


def lean(shape: Shape, mapping: SlotMapping, size: int) -> Layout:
    """With little padding: scenes that bring about as many tokens and see about as many places ask together,
    others in a call of their own.

    Args:
        shape: see there; a row a scene.
        mapping: where the tokens go and what they see.
        size: tokens of the pass; those behind the mapped ones are padding, and nothing becomes of them.
    """
    brought, ends = _brought(mapping)
    parts = [
        Part(
            run.start, run.stop - run.start, int(brought[run].max()), min(int(ends[run].max()), shape.length)
        )
        for run in _together(brought, ends)
        if brought[run].any()
    ]
    slots, back, into, hidden = _laid_out(shape, mapping, parts)
    return Layout(tuple(parts), slots.ravel(), into, padded(back, size, "constant").ravel(), hidden)


def alike(shape: Shape, mapping: SlotMapping, size: int) -> Layout:
    """With few sizes, so that most passes are like one before: all scenes ask together.

    Takes what `lean` takes. Padding repeats the last token in everything, so that it writes once more what
    that writes.
    """
    brought, ends = _brought(mapping)
    rows = min(1 << (len(brought) - 1).bit_length(), shape.rows)
    span = min(-(-int(ends.max()) // _LONG_SPAN) * _LONG_SPAN, shape.length)
    part = Part(0, rows, pass_size(int(brought.max())), span)
    slots, back, into, hidden = _laid_out(shape, mapping, [part])
    return Layout(
        (part,), padded(slots, size, "edge").ravel(), into, padded(back, size, "edge").ravel(), hidden
    )


class Walk(NamedTuple):
    """The way of a draw's row through the places of its prompt's row.

    Attributes:
        prompt: the row of its prompt.
        path: int64 [n], places of the prompt's tokens and of its own, in the order of the text.
        fed: how many of the last of them come in the pass.
    """

    prompt: int
    path: IntArray
    fed: int


class Stretch(NamedTuple):
    """Tokens from ``start`` to ``stop`` of a text, which look at its first ``span`` places."""

    start: int
    stop: int
    span: int


class Asking(NamedTuple):
    """Tokens that ask in one call, a row each stretch of a walk.

    Attributes:
        keys: int64 [rows, groups, span], where what they look at lies in the flat memory, in order.
        into: int64 [rows, groups, width, heads of the group], which query of the pass [t x h] each one is.
        seen: int64 [rows, width], how many of the first places a token sees.
    """

    keys: IntArray
    into: IntArray
    seen: IntArray


class InOrder(NamedTuple):
    """Where the tokens of a pass go, and how they ask when every walk looks by itself, in its text's order.

    Attributes:
        slots: int64 [k x groups], in the flat memory.
        askings: in the order of what they ask.
        back: int64 [t x h], for every query of the pass which of those of the askings it is.
    """

    slots: IntArray
    askings: tuple[Asking, ...]
    back: IntArray


def in_order(shape: Shape, walks: Sequence[Walk], size: int) -> InOrder:
    """A layout in which what a token looks at, and in which order, depends on its own text alone.

    Args:
        shape: see there.
        walks: of the rows that feed tokens, in their order.
        size: tokens of the pass; those behind the walks' are padding, and nothing becomes of them.
    """
    heads = np.arange(shape.heads).reshape(shape.groups, -1)
    members = heads.shape[1]
    group = np.arange(shape.groups)
    together: dict[tuple[int, int], list[tuple[int, int, Stretch]]] = {}
    slots, first = [], 0
    for number, (prompt, path, fed) in enumerate(walks):
        slots.append((prompt * shape.groups + group) * shape.length + path[-fed:, None])
        begin = len(path) - fed
        for stretch in stretches(begin, len(path), shape.length):
            count = max(stretch.stop - stretch.start, -(-LEAST_QUERIES // members))
            kind = (stretch.span, 1 << (count - 1).bit_length())
            together.setdefault(kind, []).append((number, first + stretch.start - begin, stretch))
        first += fed
    back, askings, asked = np.zeros((size, shape.heads), np.int64), [], 0
    for (span, width), pieces in sorted(together.items()):
        keys = np.empty((len(pieces), shape.groups, span), np.int64)
        into = np.zeros((len(pieces), shape.groups, width, members), np.int64)
        seen = np.ones((len(pieces), width), np.int64)
        for row, (number, token, (start, stop, _)) in enumerate(pieces):
            prompt, path, _ = walks[number]
            known = path[:span]
            keys[row] = (prompt * shape.groups + group[:, None]) * shape.length
            keys[row, :, : len(known)] += known
            count = stop - start
            tokens = np.arange(token, token + count)
            seen[row, :count] = np.arange(start, stop) + 1
            into[row, :, :count] = tokens[:, None] * shape.heads + heads[:, None]
            within = (row * shape.groups + group[:, None]) * width * members + np.arange(members)
            back[tokens] = asked + within.ravel() + np.arange(count)[:, None] * members
        askings.append(Asking(keys, into, seen))
        asked += into.size
    return InOrder(np.concatenate(slots).ravel(), tuple(askings), back.ravel())


def stretches(start: int, stop: int, length: int) -> list[Stretch]:
    """The tokens from ``start`` to ``stop`` of a text, by how many of the ``length`` places they look at."""
    found = []
    while start < stop:
        span = (start // _STRETCH + 1) * _STRETCH
        found.append(Stretch(start, min(stop, span), min(span, length)))
        start = found[-1].stop
    return found


def reached(parts: Sequence[Part]) -> tuple[int, int]:
    """Rows and places that parts see."""
    return parts[-1].first + parts[-1].rows, max(part.span for part in parts)


def _brought(mapping: SlotMapping) -> tuple[IntArray, IntArray]:
    """Tokens that each row brings, and the end of what they see."""
    prompts, seen = mapping.kv_rows, mapping.seen
    brought = np.bincount(prompts)
    last = seen.shape[1] - seen[:, ::-1].argmax(axis=1)
    ends = np.full_like(brought, _SPAN)
    np.maximum.at(ends, prompts, -(-last // _SPAN) * _SPAN)
    return brought, ends


def _laid_out(
    shape: Shape, mapping: SlotMapping, parts: Sequence[Part]
) -> tuple[IntArray, IntArray, IntArray, BoolArray]:
    """`Layout`'s ``slots`` [k, groups], ``back`` [k, heads], ``into`` and ``hidden``."""
    prompts, places, seen = mapping.kv_rows, mapping.slots, mapping.seen
    heads, groups, count = shape.heads, shape.groups, len(places)
    slots = (prompts[:, None] * groups + np.arange(groups)) * shape.length + places[:, None]
    order = np.argsort(prompts, kind="stable")
    number = np.empty_like(order)
    number[order] = count_up(np.bincount(prompts))
    firsts, rows, widths, _ = np.array(parts).T
    part_of = np.searchsorted(firsts, prompts, side="right") - 1
    sizes = rows * widths
    starts = np.cumsum(sizes) - sizes
    width = widths[part_of]
    row = prompts - firsts[part_of]
    group, member = np.divmod(np.arange(heads), heads // groups)
    back = starts[part_of][:, None] * heads + member
    back += (((row[:, None] * groups + group) * width[:, None]) + number[:, None]) * (heads // groups)
    into = np.zeros(int(sizes.sum()) * heads, np.int64)
    into[back] = np.arange(count * heads).reshape(back.shape)
    every = []
    for index, part in enumerate(parts):
        mine = part_of == index
        # Where nobody asks, the first place is seen: softmax over nothing would be no number.
        hidden = np.ones((part.rows * part.width, part.span), np.bool_)
        hidden[:, 0] = False
        seeing = (row * width + number)[mine]
        hidden[seeing, : seen.shape[1]] = ~seen[mine, : part.span]
        every.append(hidden.ravel())
    return slots, back, into, np.concatenate(every)


def padded(array: IntArray, size: int, mode: Literal["constant", "edge"]) -> IntArray:
    """More rows behind those of ``array``: zeros, or its last one again."""
    return np.pad(array, ((0, size - len(array)), *[(0, 0)] * (array.ndim - 1)), mode=mode)


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
