"""What responses usually go on with, learned while they are decoded. No torch."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Final

CONTEXT: Final = 12
"""Tokens before a decision that it is remembered by: a meta-action's times and its track's name."""
_MOST: Final = 20_000
"""Contexts that are remembered; the longest unused ones are forgotten first."""
_SHARE: Final = 0.5
_SEEN: Final = 2


class Habits:
    """For the latest contexts: which tokens followed, and how often.

    A proposal is only what is fed ahead and checked, so habits change how fast a response comes and never
    what it says.
    """

    def __init__(self) -> None:
        self._followed: OrderedDict[tuple[int, ...], dict[int, int]] = OrderedDict()

    def saw(self, context: Sequence[int], token: int, times: int) -> None:
        """``token`` was chosen behind ``context``, so many times."""
        key = tuple(context[-CONTEXT:])
        counts = self._followed.setdefault(key, {})
        counts[token] = counts.get(token, 0) + times
        self._followed.move_to_end(key)
        if len(self._followed) > _MOST:
            self._followed.popitem(last=False)

    def usual(self, context: Sequence[int]) -> int | None:
        """What usually follows ``context``; None where nothing does more often than not."""
        counts = self._followed.get(tuple(context[-CONTEXT:]))
        if not counts:
            return None
        token = max(counts, key=lambda each: counts[each])
        often, seen = counts[token], sum(counts.values())
        return token if often >= _SEEN and often > _SHARE * seen else None
