"""What is fed behind a row's pending tokens, to be checked in the same pass. No torch.

A wrong guess costs its share of the pass, a right one saves a pass. Nothing that is chosen depends on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import eq
from typing import Final

import numpy as np
import numpy.typing as npt

from model.engines.torch.answers import Answers
from model.engines.torch.habits import CONTEXTS, Habits
from model.engines.torch.rows import Row
from model.engines.torch.sampler import uniform
from model.formats.pieces import FormatError

Ids = npt.NDArray[np.int64]

_AHEAD: Final = 768
"""Tokens fed ahead in a pass at most, over all its rows: with more it is too large to be quick."""
_AHEAD_A_ROW: Final = 64
"""And of one row: where a response leaves the last one to the same pictures, all behind is fed in vain."""
_SURE: Final = 0.25
"""Guesses from habits go on while the product of their shares is above this. A guess is right about as often
as the root of its share: the number that selects it is the one that the sampler uses."""
_MANY_ROWS: Final = 20
"""With fewer rows a pass is mostly its own cost, so what may save one need not be as sure."""
_HABITUAL: Final = 64
"""Decisions between more tokens than this (codes) are no matter of habit, unless they are a text's: what is
said of a scene is said in much the same words of the next one."""
_CONTEXT: Final = max(CONTEXTS)


class Ahead:
    """Guesses how rows go on, from what they and others have written."""

    def __init__(self) -> None:
        self._habits, self._answers = Habits(), Answers()

    def feed(self, row: Row, rows: int) -> tuple[list[int], list[tuple[int, Ids]]]:
        """A row's pending tokens and what may come behind them, and the decisions among both.

        Args:
            row: whose prompt is there.
            rows: that share the pass; 0 to feed nothing ahead.

        Returns:
            tokens: to be fed.
            decisions: places among the tokens, and the ids that are allowed behind them.
        """
        tokens, decisions, cursor = list(row.pending), list[tuple[int, Ids]](), row.cursor
        if cursor.done:
            return tokens, decisions
        written, controls = len(row.tokens), row.request.controls
        ahead: list[int] = []
        context = [token.id for token in row.tokens[-_CONTEXT:]]
        most = min(_AHEAD_A_ROW, _AHEAD // rows) if rows else 0
        least, sure = _SURE * min(1.0, rows / _MANY_ROWS), 1.0
        repeated = self._repeated(row)[:most]
        copied: Sequence[int] = row.proposal() if rows else ()
        while True:
            ids, place, token = cursor.allowed().ids, len(ahead), None
            decisions.append((len(tokens) + place - 1, ids))
            if place < len(repeated):
                token = repeated[place]
            elif place < len(copied):
                token = copied[place]
            elif place < most and (len(ids) <= _HABITUAL or cursor.stop_id is not None):
                number = uniform(controls.seed, row.draws[0], written + place)
                likely = self._habits.likely(context, number if controls.temperature else None)
                if likely is not None:
                    sure *= likely[1]
                    token = likely[0] if sure > least else None
            if token is None:
                break
            try:
                cursor = cursor.advance(token)
            except FormatError:
                break
            run, cursor = cursor.forced()
            new = [token, *(forced.id for forced in run)]
            ahead += new
            context += new
            if cursor.done:
                break
            # Where the format forces something else, as behind another prefill, they are left for good.
            repeated, copied = (each if _agree(each[place:], new) else () for each in (repeated, copied))
        return tokens + ahead, decisions

    def _repeated(self, row: Row) -> Sequence[int]:
        """How the last answer to the same pictures went on from here; nothing where it went another way."""
        assert row.prompt is not None
        answer, written = self._answers.last(row.prompt.shown, row.draws[0]), len(row.tokens)
        same = len(answer) > written and all(map(eq, answer, (token.id for token in row.tokens)))
        return answer[written:] if same else ()

    def saw(self, row: Row, alternatives: int, chosen: Sequence[tuple[int, tuple[int, ...]]]) -> None:
        """Draws of a row are about to write tokens, chosen among so many."""
        if alternatives <= _HABITUAL or row.cursor.stop_id is not None:
            context = [token.id for token in row.tokens[-_CONTEXT:]]
            for token, draws in chosen:
                self._habits.saw(context, token, len(draws))

    def finished(self, row: Row) -> None:
        """A row has written its whole response."""
        assert row.prompt is not None
        self._answers.keep(row.prompt.shown, row.draws, [token.id for token in row.tokens])


def _agree(expected: Sequence[int], written: Sequence[int]) -> bool:
    """Whether one begins as the other, as far as both go."""
    return all(map(eq, expected, written))
