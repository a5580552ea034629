"""Reflections that name only what is in view: the control ``cues``. No torch.

A second look that speaks of what is not there is worth nothing, whoever reads it. What is in view is what
the scene's tracks tell or, without any, the facts that the network reads from the pictures
(`model.driving.cues`). A mask leaves out the words that lead to anything else.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from model.driving.cues import cues_read, cues_tracked
from model.driving.phrases import NOTHING, Cue, sentence, unfinished
from model.driving.trajectory import FloatArray
from model.engines.engine import PlanRequest
from model.families.family import Family
from model.formats.cursor import Cursor, Token

BoolArray = npt.NDArray[np.bool_]


class Vocabulary(Protocol):
    """What a mask needs to know about a tokenizer."""

    def decode(self, ids: Sequence[int]) -> str:
        """The text of tokens."""
        ...


def cue_mask_of(
    request: PlanRequest, family: Family, vocabulary: Vocabulary, facts: FloatArray | None
) -> CueMask | None:
    """The mask of a request; None where any cue may be named, or nobody knows what is in view.

    Args:
        request: its tracks tell what is in view, if it has any.
        family: of the response.
        vocabulary: of the checkpoint.
        facts: float32 [len(FACTS)] that the network reads from the pictures; None where it reads none.
    """
    scene = request.scene
    if request.controls.cues == "any" or family.reflection is None:
        return None
    if scene.tracks is not None:
        cues = cues_tracked(scene.history, scene.route, scene.tracks)
    elif facts is not None:
        cues = cues_read(scene.history, scene.route, facts)
    else:
        return None
    return CueMask(cues, family.reflection, vocabulary)


class CueMask:
    """Which words a reflection may choose, given the cues that it may name.

    Args:
        cues: that may be named.
        section: where reflections are written.
        vocabulary: of the tokens.
    """

    def __init__(self, cues: Iterable[Cue], section: str, vocabulary: Vocabulary) -> None:
        self.sentences = tuple(sorted(map(sentence, cues)))
        self._section, self._vocabulary = section, vocabulary

    def leaves(self, cursor: Cursor, written: Sequence[Token]) -> BoolArray | None:
        """bool [k]: which of the tokens that a cursor allows remain; None where all do.

        At least one remains: a reflection may always say that nothing is to be changed, and end behind any
        of its statements.

        Args:
            cursor: at a decision.
            written: all tokens before it.
        """
        if cursor.section != self._section:
            return None
        text = self._vocabulary.decode([token.id for token in written if token.section == self._section])
        left = np.array([self._leads_on(cursor, int(token), text) for token in cursor.allowed().ids])
        return None if left.all() else left

    def _leads_on(self, cursor: Cursor, token: int, text: str) -> bool:
        """Whether a response can go on behind a token without naming what is not in view."""
        text += self._vocabulary.decode([token])
        statement = unfinished(text.lstrip())
        if any(statement.startswith(each) for each in (*self.sentences, NOTHING)):
            return True
        if not any(each.startswith(statement) for each in (*self.sentences, NOTHING, "\n")):
            return False
        cursor = cursor.advance(token)
        if cursor.done or cursor.section != self._section:
            return True
        return any(self._leads_on(cursor, int(then), text) for then in cursor.allowed().ids)
