"""What is fed behind a row's pending tokens, to be checked in the same pass. No torch.

A wrong guess costs its share of the pass, a right one saves a pass. Nothing that is chosen depends on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from model.engines.torch.answers import Answers
from model.engines.torch.habits import CONTEXTS, Habits
from model.engines.torch.rows import Row
from model.engines.torch.sampler import uniform

Ids = npt.NDArray[np.int64]

GUESSES: Final = 24
"""Decisions guessed from habits in a pass, over all its rows: two of three are right, but with many rows one
that is wrong still holds up the pass, and what is fed costs more than it saves."""
GUESSES_A_ROW: Final = 8
"""And over one row: that all of more are right is rare."""
_REPEAT_TOKENS: Final = 64
"""Fed ahead at most as the last answer to the same pictures went on."""
_HABITUAL: Final = 64
"""Decisions between more tokens than this (codes) are no matter of habit, unless they are a text's: what is
said of a scene is said in much the same words of the next one."""
_CONTEXT: Final = max(CONTEXTS)


class Ahead:
    """Guesses how rows go on, from what they and others have written."""

    def __init__(self) -> None:
        self._habits, self._answers = Habits(), Answers()

    def feed(self, row: Row, *, copy: bool, guesses: int) -> tuple[list[int], list[tuple[int, Ids]]]:
        """A row's pending tokens and what may come behind them, and the decisions among both.

        Args:
            row: whose prompt is there.
            copy: whether a revised plan is taken from the first one.
            guesses: how many decisions at most are taken from habits; unless it is 0, more is also taken
                from the last answer to the same pictures.

        Returns:
            tokens: to be fed.
            decisions: places among the tokens, and the ids that are allowed behind them.
        """
        assert row.prompt is not None
        tokens, decisions, cursor = list(row.pending), list[tuple[int, Ids]](), row.cursor
        written, controls = len(row.tokens), row.request.controls
        context = [token.id for token in row.tokens[-_CONTEXT:]]
        copied = iter(row.proposal() if copy else [])
        answer = self._answers.last(row.prompt.shown, row.draws[0]) if guesses else ()
        repeated, guessed = iter(answer[written:]), 0
        while not cursor.done:
            ids = cursor.allowed().ids
            if len(ids) > 1:
                decisions.append((len(tokens) - 1, ids))
            token, before = next(copied, None), next(repeated, None)
            if token is None and guesses:
                ahead = len(tokens) - len(row.pending)
                if len(ids) == 1:
                    token = int(ids[0])
                elif before in ids:
                    token = before if ahead < _REPEAT_TOKENS else None
                elif (len(ids) <= _HABITUAL or cursor.stop_id is not None) and guessed < guesses:
                    guessed += 1
                    number = uniform(controls.seed, row.draws[0], written + ahead)
                    token = self._habits.likely(context, number if controls.temperature else None)
            if token is None or token not in ids:
                break
            tokens.append(token)
            context.append(token)
            cursor = cursor.advance(token)
        return tokens, decisions

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
