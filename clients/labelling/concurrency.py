"""How many calls go out at once: as many as the other side takes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from looktwice.clients.retries import TryLater


class ConcurrencyLimit:
    """So many calls at once: one more for every so many that succeed, half as many when it was too much.

    Additive increase, multiplicative decrease, as TCP does it; calls that were under way together count as
    one sign of overload.

    Args:
        most: never more at once.
    """

    def __init__(self, most: int) -> None:
        self._most, self._allowed, self._inside = most, float(min(most, 4)), 0
        self._calls = 0
        self._shrunk_at = 0
        self._room = asyncio.Condition()

    @property
    def allowed(self) -> int:
        """How many may be under way now."""
        return max(1, int(self._allowed))

    @asynccontextmanager
    async def slot(self) -> AsyncIterator[None]:
        """Wait for a place; a block that ends in `TryLater` shows that there are too many."""
        async with self._room:
            await self._room.wait_for(lambda: self._inside < self.allowed)
            self._inside += 1
            self._calls += 1
            number = self._calls
        try:
            yield
            self._allowed = min(self._most, self._allowed + 1 / self._allowed)
        except TryLater:
            if number > self._shrunk_at:
                self._allowed, self._shrunk_at = max(1.0, self._allowed / 2), self._calls
            raise
        finally:
            async with self._room:
                self._inside -= 1
                self._room.notify_all()
