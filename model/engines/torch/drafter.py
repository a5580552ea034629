"""Speculation: guesses of how a response goes on, verified in the pass that feeds them. No torch.

A wrong guess costs its share of the pass, a right one saves a pass. Guesses never change what is chosen.
There are four sources, asked in this order:

1. the last response to the same pictures, while the row agrees with it (`_Responses`);
2. the first plan, while a revised plan repeats it;
3. within a picture that is imagined: what the last pass would have written there, had all guesses before it
   been right (Jacobi decoding, https://arxiv.org/abs/2305.10427), or else the code that is expected there,
   which stands before it;
4. what followed the same last tokens in any response (`_Ngrams`).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from operator import eq
from typing import Final

import numpy as np
import numpy.typing as npt
from cachetools import FIFOCache

from looktwice.model.engines.sampling import uniform
from looktwice.model.engines.torch.rows import Row
from looktwice.model.formats.cursor import AtCode, Cursor
from looktwice.model.formats.pieces import FormatError

Ids = npt.NDArray[np.int64]
Logits = npt.NDArray[np.float64]

_MAX_TOKENS: Final = 768
"""Guessed tokens of a pass, over all its rows: with more it is too large to be quick."""
_MAX_ROW_TOKENS: Final = 64
"""Guessed tokens of one row: all are wasted behind the point where a response leaves the last one."""
_LEAST_SHARE: Final = 0.25
"""N-gram guesses go on while the product of their shares is above this. A guess is right about as often
as the root of its share: the number that selects it is the one that the sampler uses."""
_MANY_ROWS: Final = 20
"""With fewer rows a pass is mostly its own cost, so a guess need not be as sure."""
_MAX_OPTIONS: Final = 64
"""Decisions between more tokens (codes) do not repeat, unless they are those of a text: one scene is
described in much the same words as the next."""
_CONTEXTS: Final = (16, 12, 8, 4)
"""Context lengths, the most telling first. The last four tokens, which are nearly always known, hold a
track's name."""
_MAX_CONTEXTS: Final = 50_000
_MAX_RESPONSES: Final = 256
"""Scenes whose last responses are kept; each takes some 10 kB."""


class Drafter:
    """Proposes how rows go on, from what they and others have written."""

    def __init__(self) -> None:
        self._ngrams, self._responses = _Ngrams(), _Responses()

    def propose(self, row: Row, rows: int) -> tuple[list[int], list[tuple[int, Ids]]]:
        """A row's pending tokens with guesses behind them, and the decisions among both.

        Args:
            row: whose prompt is prefilled.
            rows: that share the pass; 0 to guess nothing.

        Returns:
            tokens: to be fed.
            decisions: positions among the tokens, and the ids that are allowed behind each.
        """
        tokens, decisions, cursor = list(row.pending), list[tuple[int, Ids]](), row.cursor
        if cursor.done:
            return tokens, decisions
        written, controls = len(row.tokens), row.request.controls
        guessed: list[int] = []
        context = [token.id for token in row.tokens[-max(_CONTEXTS) :]]
        most = min(_MAX_ROW_TOKENS, _MAX_TOKENS // rows) if rows else 0
        least, share = _LEAST_SHARE * min(1.0, rows / _MANY_ROWS), 1.0
        repeated = self._repeated(row)[:most]
        copied: Sequence[int] = _first_plan(row) if rows else ()
        while True:
            ids, position, token = cursor.allowed().ids, len(guessed), None
            decisions.append((len(tokens) + position - 1, ids))
            if position < len(repeated):
                token = repeated[position]
            elif position < len(copied):
                token = copied[position]
            elif position < most and (expected := _code_expected(row, cursor, context)) is not None:
                token = row.foreseen.get(written + position, expected)
            elif position < most and (len(ids) <= _MAX_OPTIONS or cursor.stop_id is not None):
                number = uniform(controls.seed, row.draws[0], written + position)
                likely = self._ngrams.likely(context, number if controls.temperature else None)
                if likely is not None:
                    share *= likely[1]
                    token = likely[0] if share > least else None
            if token is None:
                break
            try:
                cursor = cursor.advance(token)
            except FormatError:
                break
            run, cursor = cursor.forced()
            new = [token, *(forced.id for forced in run)]
            guessed += new
            context += new
            if cursor.done:
                break
            # Where the format forces something else (another prefill), a source is left for good.
            repeated, copied = (each if _agree(each[position:], new) else () for each in (repeated, copied))
        return tokens + guessed, decisions

    def observe(self, row: Row, options: int, chosen: Sequence[tuple[int, tuple[int, ...]]]) -> None:
        """Draws of a row are about to write ``chosen`` tokens, each out of so many options."""
        if options <= _MAX_OPTIONS or row.cursor.stop_id is not None:
            context = [token.id for token in row.tokens[-max(_CONTEXTS) :]]
            for token, draws in chosen:
                self._ngrams.count(context, token, len(draws))

    def look_again(self, row: Row, places: Sequence[int], logits: Sequence[Logits]) -> None:
        """A guess of a row was wrong: keep what it would have written behind it, at places of its response.

        Where one code of a picture is another one, most that follow stay as they are.
        """
        before = [token.id for token in row.tokens[-1:]]
        row.foreseen = {}
        if _code_expected(row, row.cursor, before) is not None:
            options = len(row.cursor.allowed().ids)
            row.foreseen = {
                place: row.would_choose(values, place)
                for place, values in zip(places, logits, strict=True)
                if len(values) == options
            }

    def finished(self, row: Row) -> None:
        """A row has written its whole response."""
        self._responses.keep(row.shown, row.draws, [token.id for token in row.tokens])

    def _repeated(self, row: Row) -> Sequence[int]:
        """How the last response to the same pictures went on from here; nothing where it went another way."""
        last, written = self._responses.last(row.shown, row.draws[0]), len(row.tokens)
        same = len(last) > written and all(map(eq, last, (token.id for token in row.tokens)))
        return last[written:] if same else ()


def _code_expected(row: Row, cursor: Cursor, written: Sequence[int]) -> int | None:
    """The token before a code of a picture: that of the code that is expected there; None elsewhere."""
    imagination = row.request.family.imagination
    if imagination is None or cursor.section != imagination.section or not row.request.expects:
        return None
    return written[-1] if isinstance(cursor.active, AtCode) else None


def _first_plan(row: Row) -> Sequence[int]:
    """Within a revised plan: how the first plan went on from here, while the revised one repeats it."""
    family = row.request.family
    if row.cursor.section != family.revised_plan:
        return ()
    first = [token.id for token in row.tokens if token.section == family.first_plan]
    revised = [token.id for token in row.tokens if token.section == family.revised_plan]
    return first[len(revised) :] if first[: len(revised)] == revised else ()


def _agree(expected: Sequence[int], written: Sequence[int]) -> bool:
    """Whether one begins as the other, as far as both go."""
    return all(map(eq, expected, written))


class _Responses:
    """The tokens of the latest draws for the same pictures and format, draw by draw.

    Random numbers depend on seed, draw and position. Asked again with the same seed, a model that sees the
    same pictures mostly writes the same, whatever moved by a tenth of a second.
    """

    def __init__(self) -> None:
        self._kept: FIFOCache[bytes, dict[int, tuple[int, ...]]] = FIFOCache(_MAX_RESPONSES)

    def keep(self, shown: bytes, draws: Sequence[int], tokens: Sequence[int]) -> None:
        """``draws`` of a scene with the pictures ``shown`` have written ``tokens``."""
        self._kept[shown] = self._kept.get(shown, {}) | dict.fromkeys(draws, tuple(tokens))

    def last(self, shown: bytes, draw: int) -> tuple[int, ...]:
        """What ``draw`` wrote the last time; nothing where that is not known."""
        return self._kept.get(shown, {}).get(draw, ())


class _Ngrams:
    """For the latest contexts: which tokens followed, and how often."""

    def __init__(self) -> None:
        # No cachetools here: it takes 1.4 instead of 0.3 µs, for up to four contexts of every guess.
        self._followed: OrderedDict[tuple[int, ...], dict[int, int]] = OrderedDict()

    def count(self, context: Sequence[int], token: int, times: int) -> None:
        """``token`` was chosen behind ``context``, so many times."""
        # The beginning of a response is shorter than some contexts, which are then one and the same.
        for key in dict.fromkeys(tuple(context[-length:]) for length in _CONTEXTS):
            counts = self._followed.setdefault(key, {})
            counts[token] = counts.get(token, 0) + times
            self._followed.move_to_end(key)
        while len(self._followed) > _MAX_CONTEXTS:
            self._followed.popitem(last=False)

    def likely(self, context: Sequence[int], number: float | None) -> tuple[int, float] | None:
        """The token behind ``context`` that a random number in [0, 1) selects; None where nothing is known.

        The sampler selects with the same number in the same order of ids. As far as these counts are like the
        model's probabilities, both select the same token, however flat the distribution is. Without a number
        it is the most frequent token.

        Returns:
            token: the guess.
            share: of what followed the context, as if something else had followed it once more.
        """
        for length in _CONTEXTS:
            counts = self._followed.get(tuple(context[-length:]))
            if counts:
                break
        else:
            return None
        total = sum(counts.values())
        if number is None:
            token = max(counts, key=lambda token: counts[token])
        else:
            left = number * total
            for token in sorted(counts):
                left -= counts[token]
                if left < 0:
                    break
        return token, counts[token] / (total + 1)
