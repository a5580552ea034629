"""Asking again later whoever is busy now."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Final, TypeVar

import stamina

_Result = TypeVar("_Result")
_LONGEST_WAIT_S: Final = 30.0
_SHORTEST_WAIT_S: Final = 0.2
"""Also where whoever is busy asks to be asked again at once."""


class TryLater(Exception):
    """Whoever was asked is busy or not there; the same may succeed later.

    Attributes:
        wait_s: how long it asked to wait; None where it did not ask.
    """

    def __init__(self, told: str, wait_s: float | None = None) -> None:
        super().__init__(told)
        self.wait_s = wait_s


async def with_retries(call: Callable[[], Awaitable[_Result]], give_up_after_s: float) -> _Result:
    """What a call gives in the end; it is made again, ever later, while it ends in `TryLater`.

    Raises:
        TryLater: it still did after so many seconds, or asked to wait for longer than that.
    """

    def wait(error: Exception) -> bool | float:
        if not isinstance(error, TryLater):
            return False
        if error.wait_s is None:
            return True
        return max(_SHORTEST_WAIT_S, error.wait_s) if error.wait_s <= give_up_after_s else False

    async for attempt in stamina.retry_context(
        on=wait,
        attempts=None,
        timeout=give_up_after_s,
        wait_initial=_SHORTEST_WAIT_S,
        wait_max=_LONGEST_WAIT_S,
    ):
        with attempt:
            return await call()
    raise AssertionError("the last attempt returns or raises")
