"""How much one caller may ask for over time."""

from __future__ import annotations

import time

from limits import RateLimitItem, parse
from limits.aio.storage import MemoryStorage
from limits.aio.strategies import MovingWindowRateLimiter


class RateLimited(Exception):
    """The caller has asked for as much as is allowed.

    Attributes:
        retry_after_s: when there will be room again; None where the request can never be allowed.
    """

    def __init__(self, detail: str, retry_after_s: float | None) -> None:
        super().__init__(detail)
        self.retry_after_s = retry_after_s


class Rates:
    """Draws per owner of a key in a moving window.

    Args:
        limit: such as ``6000/minute``; None for no limit.

    Raises:
        ValueError: ``limit`` cannot be read.
    """

    def __init__(self, limit: str | None) -> None:
        self._limit: RateLimitItem | None = None if limit is None else parse(limit)
        self._limiter = MovingWindowRateLimiter(MemoryStorage())

    async def spend(self, owner: str, draws: int) -> None:
        """Count ``draws`` for ``owner``; raises `RateLimited` and counts nothing where they are too many."""
        if self._limit is None or await self._limiter.hit(self._limit, owner, cost=draws):
            return
        if draws > self._limit.amount:
            raise RateLimited(f"{draws} draws at once are more than {self._limit}, the limit of a key", None)
        window = await self._limiter.get_window_stats(self._limit, owner)
        wait_s = max(0.0, window.reset_time - time.time())
        raise RateLimited(f"{self._limit} is the limit of a key; {window.remaining} draws are left", wait_s)
