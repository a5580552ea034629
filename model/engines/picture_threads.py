"""Threads that decode pictures, and nothing else: what takes long there holds up nobody elsewhere."""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import Final, TypeVar

from looktwice.model.driving.images import ImageError, check_image, decoding_while
from looktwice.model.engines.engine import EngineError

_Result = TypeVar("_Result")
THREADS: Final = 2
LARGE_THREADS: Final = 1
LARGE_NICENESS: Final = 10
"""Of their thread, above that of the process: where processors are short, the engine goes before it."""
LARGE_PIXELS: Final = 2_000_000
"""Of all pictures of a scene, one of full HD: scenes with more wait for each other, and hold up no others."""


class PictureThreads:
    """Runs work on pictures for one event loop; scenes with large ones have a thread apart."""

    def __init__(self) -> None:
        self._pools: dict[bool, ThreadPoolExecutor] = {}
        self._numbers, self._since_s = count(), dict[int, float]()
        self._left: dict[int, threading.Event] = {}

    @property
    def waiting_s(self) -> float:
        """How long the oldest piece of work has waited to be finished; 0 where there is none.

        Of large ones only the one that is worked on counts: that others wait behind it says nothing about the
        rest of the service.
        """
        since_s = list(self._since_s.values())  # at once: a thread may end its piece meanwhile
        return time.monotonic() - min(since_s) if since_s else 0.0

    async def run(self, work: Callable[[], _Result], pictures: Sequence[bytes] = ()) -> _Result:
        """What ``work`` on ``pictures`` gives; it ends at its next picture once nobody waits for it any more.

        Raises:
            ImageError: one of the pictures is none.
            EngineError: it was dropped, or ended, by `close`.
        """
        if await self._run(lambda: _pixels(pictures) > LARGE_PIXELS, large=False):
            return await self._run(work, large=True)
        return await self._run(work, large=False)

    async def _run(self, work: Callable[[], _Result], *, large: bool) -> _Result:
        if large not in self._pools:
            threads, begin = (LARGE_THREADS, _give_way) if large else (THREADS, None)
            self._pools[large] = ThreadPoolExecutor(threads, "looktwice-pictures", begin)
        pool, number, left = self._pools[large], next(self._numbers), threading.Event()

        def begun() -> _Result:
            self._since_s.setdefault(number, time.monotonic())
            with decoding_while(lambda: not left.is_set()):
                return work()

        def done(_: object) -> None:
            self._since_s.pop(number, None)
            self._left.pop(number, None)

        if not large:
            self._since_s[number] = time.monotonic()
        self._left[number] = left
        future = pool.submit(begun)
        future.add_done_callback(done)
        try:
            return await asyncio.wrap_future(future)
        except asyncio.CancelledError:
            left.set()
            if future.cancelled() and self._pools.get(large) is not pool:
                raise EngineError("the engine was stopped") from None
            raise
        except ImageError:
            # Nobody but `close` ends what is still waited for.
            if left.is_set():
                raise EngineError("the engine was stopped") from None
            raise

    def close(self) -> None:
        """Drop what has not begun; what has begun ends at its next picture."""
        for left in list(self._left.values()):
            left.set()
        for pool in self._pools.values():
            pool.shutdown(wait=False, cancel_futures=True)
        self._pools.clear()


def _give_way() -> None:
    """Lower the priority of this thread; elsewhere than in Linux only whole processes have one."""
    if sys.platform == "linux":
        thread = threading.get_native_id()
        niceness = os.getpriority(os.PRIO_PROCESS, thread) + LARGE_NICENESS
        os.setpriority(os.PRIO_PROCESS, thread, niceness)


def _pixels(pictures: Sequence[bytes]) -> int:
    return sum(width * height for width, height in map(check_image, pictures))
