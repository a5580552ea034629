"""A thread of its own for torch."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


class Worker:
    """Carries out one job after the other on one thread.

    All of an engine's torch is done there: where two threads each bring a team of OpenMP threads, there are
    more of these than cores, none of them waits actively any more, and every operation takes twice as long.
    """

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[], T]) -> Future[T]:
        """Queue ``job``; the future holds its result or its exception."""
        future: Future[T] = Future()

        def carry_out() -> None:
            try:
                future.set_result(job())
            except BaseException as error:  # whoever waits for the future hears of it
                future.set_exception(error)

        self._jobs.put(carry_out)
        return future

    def close(self) -> None:
        """End the thread, once its jobs are done. An interpreter that ends before it may crash in torch."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()
