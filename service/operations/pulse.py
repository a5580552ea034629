"""Whether the event loop, or the threads beside it, stood still lately: then nobody was answered."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import Final

_PERIOD_S: Final = 0.2
_REMEMBERED_S: Final = 5.0
"""Long enough that a probe every few seconds hears of it."""


class Pulse:
    """Beats while the loop runs, and knocks at the threads that requests are checked on."""

    def __init__(self) -> None:
        self._late: deque[tuple[float, float]] = deque()
        self._due_s: float | None = None
        self._beating: asyncio.Task[None] | None = None
        self._knock: asyncio.Future[None] | None = None
        self._knocked_s = 0.0

    @property
    def stood_still_s(self) -> float:
        """The longest that the loop kept anybody waiting lately."""
        now_s = time.monotonic()
        late = [late_s for at_s, late_s in self._late if at_s >= now_s - _REMEMBERED_S]
        if self._due_s is not None:
            # Whoever waited through a stall may ask before the beat that was due meanwhile.
            late.append(now_s - self._due_s)
        return max([0.0, *late])

    @property
    def threads_wait_s(self) -> float:
        """How long the loop's own threads have let a piece of work wait that takes no time."""
        if self._knock is None or self._knock.done():
            return 0.0
        return time.monotonic() - self._knocked_s

    def begin(self) -> None:
        """Beat from now on, in the running loop."""
        self._beating = asyncio.create_task(self._beat(), name="pulse")

    def end(self) -> None:
        """Beat no more."""
        if self._beating is not None:
            self._beating.cancel()

    async def _beat(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            if self._knock is None or self._knock.done():
                self._knocked_s = time.monotonic()
                self._knock = loop.run_in_executor(None, lambda: None)
            self._due_s = time.monotonic() + _PERIOD_S
            await asyncio.sleep(_PERIOD_S)
            now_s = time.monotonic()
            self._late.append((now_s, now_s - self._due_s))
            while self._late[0][0] < now_s - _REMEMBERED_S:
                self._late.popleft()
