"""Whether the event loop has stood still lately: then nobody was answered, whatever probes say afterwards."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import Final

_PERIOD_S: Final = 0.2
_REMEMBERED_S: Final = 5.0
"""Long enough that a probe every few seconds hears of it."""


class Pulse:
    """Beats while the loop runs."""

    def __init__(self) -> None:
        self._late: deque[tuple[float, float]] = deque()
        self._beating: asyncio.Task[None] | None = None

    @property
    def stood_still_s(self) -> float:
        """The longest that the loop kept anybody waiting lately."""
        since_s = time.monotonic() - _REMEMBERED_S
        return max((late_s for at_s, late_s in self._late if at_s >= since_s), default=0.0)

    def begin(self) -> None:
        """Beat from now on, in the running loop."""
        self._beating = asyncio.create_task(self._beat(), name="pulse")

    def end(self) -> None:
        """Beat no more."""
        if self._beating is not None:
            self._beating.cancel()

    async def _beat(self) -> None:
        while True:
            due_s = time.monotonic() + _PERIOD_S
            await asyncio.sleep(_PERIOD_S)
            now_s = time.monotonic()
            self._late.append((now_s, now_s - due_s))
            while self._late[0][0] < now_s - _REMEMBERED_S:
                self._late.popleft()
