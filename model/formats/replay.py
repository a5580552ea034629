"""Walking a finished response again: where it was decided, and between what."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.formats.cursor import Cursor
from looktwice.model.formats.pieces import FormatError


class Decision(NamedTuple):
    """A token of a response at which the format leaves more than one.

    Attributes:
        position: in the response.
        ids: int64 [k] that are allowed, ascending.
        place: of the response's token among them.
    """

    position: int
    ids: npt.NDArray[np.int64]
    place: int


def decisions(start: Cursor, ids: Sequence[int]) -> list[Decision]:
    """The decisions of a whole response, in order; all other tokens are forced.

    Args:
        start: where the response begins.
        ids: its tokens.

    Raises:
        FormatError: no cursor writes them, or the response goes on behind them.
    """
    cursor, found = start, list[Decision]()
    for position, token in enumerate(ids):
        allowed = cursor.allowed().ids
        cursor = cursor.advance(token)
        if len(allowed) > 1:
            found.append(Decision(position, allowed, int(np.searchsorted(allowed, token))))
    if not cursor.done:
        raise FormatError(f"the response goes on behind its {len(ids)} tokens")
    return found
