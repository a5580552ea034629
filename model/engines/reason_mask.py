"""Reflections that state only what the view gives a reason for: the control ``reasons``. No torch.

A second look that speaks of what is not there is worth nothing, whoever reads it. What is in view is what
the scene's tracks tell or, without any, the facts that the network reads from the pictures
(`looktwice.model.driving.reasons`). A mask leaves out the words that lead to any other statement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, partial
from typing import Protocol

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.phrases import NOTHING, Statement, unfinished
from looktwice.model.driving.reasons import reasons_read, reasons_tracked
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.engines.engine import PlanRequest
from looktwice.model.families.family import Family
from looktwice.model.formats.cursor import Cursor, Token
from looktwice.model.formats.phrase_pieces import in_phrases

BoolArray = npt.NDArray[np.bool_]


class MaskVocabulary(Protocol):
    """What a mask needs to know about a tokenizer."""

    def decode(self, ids: Sequence[int]) -> str:
        """The text of tokens."""
        ...


def reason_mask_of(
    request: PlanRequest, family: Family, vocabulary: MaskVocabulary, facts: FloatArray | None
) -> ReasonMask | None:
    """The mask of a request; None where anything may be stated, or nobody knows what is in view.

    Args:
        request: its tracks tell what is in view, if it has any.
        family: of the response.
        vocabulary: of the checkpoint.
        facts: float32 [len(FACTS)] that the network reads from the pictures; None where it reads none.
    """
    scene = request.scene
    if request.controls.reasons == "any" or family.reflection is None or not in_phrases(family.format):
        return None
    if scene.tracks is not None:
        reasons = partial(reasons_tracked, scene.history, scene.route, scene.tracks)
    elif facts is not None:
        reasons = partial(reasons_read, scene.history, scene.route, facts)
    else:
        return None
    return ReasonMask(reasons, family.reflection, vocabulary)


class ReasonMask:
    """Which words a reflection may choose, given the statements that it may make.

    Args:
        reasons: works out the statements, which takes a millisecond; asked once, at the first reflection.
        section: where reflections are written.
        vocabulary: of the tokens.
    """

    def __init__(
        self, reasons: Callable[[], Iterable[Statement]], section: str, vocabulary: MaskVocabulary
    ) -> None:
        self._reasons, self._section, self._vocabulary = reasons, section, vocabulary

    @cached_property
    def statements(self) -> tuple[str, ...]:
        """That may be made, in the order of the alphabet."""
        return tuple(sorted(map(str, self._reasons())))

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
        """Whether behind a token a statement that may be made can be finished, or the section ends."""
        text += self._vocabulary.decode([token])
        begun = unfinished(text.strip())
        if not any(each.startswith(begun) for each in (*self.statements, NOTHING)):
            return False
        cursor = cursor.advance(token)
        if cursor.done or cursor.section != self._section:
            return True
        if text.endswith(self.statements):
            return True
        return any(self._leads_on(cursor, int(then), text) for then in cursor.allowed().ids)
