"""What responses go on with, learned while they are decoded. No torch."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Final

CONTEXTS: Final = (16, 12, 8, 4)
"""Tokens before a decision that it is remembered by, the most telling first: where the same sixteen came
before, what followed them says most; the last four, which are nearly always known, hold a track's name."""
_MOST: Final = 50_000
"""Contexts that are remembered; the longest unused ones are forgotten first."""


class Habits:
    """For the latest contexts: which tokens followed, and how often.

    A proposal is only what is fed ahead and checked, so habits change how fast a response comes and never
    what it says.
    """

    def __init__(self) -> None:
        self._followed: OrderedDict[tuple[int, ...], dict[int, int]] = OrderedDict()

    def saw(self, context: Sequence[int], token: int, times: int) -> None:
        """``token`` was chosen behind ``context``, so many times."""
        # Of a beginning, which is shorter than some of them, once.
        for key in dict.fromkeys(tuple(context[-length:]) for length in CONTEXTS):
            counts = self._followed.setdefault(key, {})
            counts[token] = counts.get(token, 0) + times
            self._followed.move_to_end(key)
        while len(self._followed) > _MOST:
            self._followed.popitem(last=False)

    def likely(self, context: Sequence[int], number: float | None) -> tuple[int, float] | None:
        """The token behind ``context`` that a random number in [0, 1) selects; None where nothing is known.

        The sampler selects with the same number in the same order of ids, so as far as habits are like the
        model's probabilities the two select the same token, however undecided both are. Without a number it
        is the most frequent token.

        Returns:
            token: the guess.
            share: of what followed the context, as if something else had followed it once more.
        """
        for length in CONTEXTS:
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
