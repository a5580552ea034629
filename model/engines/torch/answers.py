"""The latest answers, by what scenes showed: planners ask again before pictures change. No torch."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Final

_KEPT: Final = 256
"""Scenes; each some 10 kB."""


class Answers:
    """The tokens of the latest draws for the same pictures and format, draw by draw.

    Random numbers depend on seed, draw and position: asked again with the same seed, a model that sees the
    same pictures mostly writes the same, whatever moved by a tenth of a second.
    """

    def __init__(self) -> None:
        self._kept: OrderedDict[bytes, dict[int, tuple[int, ...]]] = OrderedDict()

    def keep(self, shown: bytes, draws: Sequence[int], tokens: Sequence[int]) -> None:
        """``draws`` of a scene that ``shown`` stands for have written ``tokens``."""
        answer = self._kept.setdefault(shown, {})
        answer |= dict.fromkeys(draws, tuple(tokens))
        self._kept.move_to_end(shown)
        if len(self._kept) > _KEPT:
            self._kept.popitem(last=False)

    def last(self, shown: bytes, draw: int) -> tuple[int, ...]:
        """What ``draw`` wrote the last time; nothing where that is not known."""
        return self._kept.get(shown, {}).get(draw, ())
