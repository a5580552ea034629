"""Threads that decode pictures, and nothing else: what takes long there holds up nobody elsewhere."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import Final, TypeVar

_Result = TypeVar("_Result")
THREADS: Final = 2


class PictureThreads:
    """Runs work on pictures for one event loop."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._numbers, self._since_s = count(), dict[int, float]()

    @property
    def waiting_s(self) -> float:
        """How long the oldest piece of work has waited to be finished; 0 where there is none."""
        return time.monotonic() - min(self._since_s.values()) if self._since_s else 0.0

    async def run(self, work: Callable[[], _Result]) -> _Result:
        """What ``work`` gives. Who stops waiting leaves work that has begun to end by itself."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(THREADS, "looktwice-pictures")
        number = next(self._numbers)
        self._since_s[number] = time.monotonic()
        future = self._pool.submit(work)
        future.add_done_callback(lambda _: self._since_s.pop(number))
        return await asyncio.wrap_future(future)

    def close(self) -> None:
        """Drop what has not begun."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None
