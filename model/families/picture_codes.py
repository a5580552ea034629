"""A picture as codes: what every family that imagines pictures writes them in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Final, TypeVar

Code = TypeVar("Code", int, "int | None")

PICTURE: Final = "visual"
"""The alphabet of picture codes."""
PICTURE_CODES: Final = 98
"""Of a picture; `looktwice.model.network.visual_codes` makes them."""
PICTURE_CODEBOOK: Final = 1000
"""How many different codes there are."""
BLANK: Final = (500,) * PICTURE_CODES
"""The picture that is expected where nothing is known: the middle of all levels, everywhere."""


def beside(expected: Sequence[int] | None, codes: Iterable[Code]) -> tuple[Code, ...]:
    """Codes, each behind the one that is expected at its place; `BLANK` where nothing is.

    What a camera sees now is most of what it will see. A network that reads a code where it writes the next
    one learns that at once. In the prompt, hundreds of tokens before, it was not found.
    """
    return tuple(chain.from_iterable(zip(BLANK if expected is None else expected, codes, strict=True)))
