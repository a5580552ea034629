"""A picture as codes: what every family that imagines pictures writes them in."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]
Code = TypeVar("Code", int, "int | None")

PICTURE: Final = "visual"
"""The alphabet of picture codes."""
PICTURE_CODES: Final = 98
"""Of a picture, row by row from the upper left; `looktwice.model.network.visual_codes` makes them."""
LEVELS: Final = (8, 5, 5, 5)
"""Each code is four numbers; so many different ones there are of each."""
PICTURE_CODEBOOK: Final = math.prod(LEVELS)
"""How many different codes there are."""
_WEIGHTS: Final = np.cumprod((1, *LEVELS[:-1])).astype(np.int64)
"""What a level counts in a code: the first changes fastest."""
BLANK: Final = (500,) * PICTURE_CODES
"""The picture that is expected where nothing is known: the middle of all levels, everywhere."""


class VisualCodesError(ValueError):
    """Codes, a picture or a file that cannot be used; the text says why."""


def levels_of(codes: npt.ArrayLike) -> IntArray:
    """The levels int64 [..., 4] of codes [...]; raises `VisualCodesError` for a number that is no code."""
    numbers = np.asarray(codes)
    if not np.issubdtype(numbers.dtype, np.integer):
        raise VisualCodesError(f"codes are whole numbers, not {numbers.dtype}")
    if ((numbers < 0) | (numbers >= PICTURE_CODEBOOK)).any():
        most = PICTURE_CODEBOOK - 1
        raise VisualCodesError(f"codes lie in 0..{most}, got {numbers.min()} to {numbers.max()}")
    levels: IntArray = numbers.astype(np.int64)[..., None] // _WEIGHTS % np.array(LEVELS)
    return levels


def codes_of(levels: npt.ArrayLike) -> IntArray:
    """The codes int64 [...] of levels [..., 4]: `levels_of` undone; raises `VisualCodesError`."""
    numbers = np.asarray(levels)
    if numbers.shape[-1:] != (len(LEVELS),) or not np.issubdtype(numbers.dtype, np.integer):
        raise VisualCodesError(f"levels are whole numbers [..., {len(LEVELS)}]")
    if ((numbers < 0) | (numbers >= np.array(LEVELS))).any():
        raise VisualCodesError(f"levels lie below {', '.join(map(str, LEVELS))}, and from 0 on")
    codes: IntArray = (numbers.astype(np.int64) * _WEIGHTS).sum(axis=-1)
    return codes


def beside(expected: Sequence[int] | None, codes: Iterable[Code]) -> tuple[Code, ...]:
    """Codes, each behind the one that is expected at its place; `BLANK` where nothing is.

    What a camera sees now is most of what it will see. A network that reads a code where it writes the next
    one learns that at once. In the prompt, hundreds of tokens before, it was not found.
    """
    return tuple(chain.from_iterable(zip(BLANK if expected is None else expected, codes, strict=True)))
