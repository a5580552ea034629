"""Processes that run a load, so that nothing else holds up what is due."""

from __future__ import annotations

import asyncio
import gc
import multiprocessing
import os
import threading
import time
from multiprocessing.connection import Connection
from typing import Final

from loadtests.exchange import Exchange
from loadtests.loads import Load
from loadtests.sending import Sender, Target, connected

_HEAD_START_S: Final = 0.2
"""From the last worker's word that it is ready until the run begins."""


class WorkerDied(RuntimeError):
    """A process of the generator ended before its load did."""


class Crew:
    """Worker processes for one run.

    ::

        with Crew(load, target, workers=2) as crew:
            starts_at = crew.begin()   # time.monotonic() of the run's start
            exchanges = crew.finish()
    """

    def __init__(self, load: Load, target: Target, workers: int) -> None:
        # Spawned: a fork would copy whatever threads the caller has.
        context = multiprocessing.get_context("spawn")
        self._crew: list[tuple[multiprocessing.process.BaseProcess, Connection[object, object]]] = []
        for part in load.split(workers):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(part, target, theirs), daemon=True)
            process.start()
            theirs.close()
            self._crew.append((process, ours))

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *_: object) -> None:
        for process, pipe in self._crew:
            process.terminate()
            process.join()
            pipe.close()

    def begin(self) -> float:
        """Wait until all are ready, start them together, and return when they start; raises `WorkerDied`."""
        for _, pipe in self._crew:
            _told(pipe)
        starts_at = time.monotonic() + _HEAD_START_S
        for _, pipe in self._crew:
            pipe.send(starts_at)
        return starts_at

    def finish(self) -> list[Exchange]:
        """All exchanges, in the order they were due; raises `WorkerDied`."""
        exchanges: list[Exchange] = []
        for _, pipe in self._crew:
            exchanges += _told(pipe)  # type: ignore[arg-type]
        return sorted(exchanges, key=lambda each: each.due_s)


def _told(pipe: Connection[object, object]) -> object:
    try:
        return pipe.recv()
    except EOFError:
        raise WorkerDied("a worker process of the load generator died; its own output says why") from None


def _end_with_parent() -> None:
    """A generator that was killed must not go on sending: the next run would share the service with it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(load: Load, target: Target, pipe: Connection[object, object]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pipe.send("ready")
    starts_at = pipe.recv()
    assert isinstance(starts_at, float)
    # What was prepared stays until the end: the collector need not look through it again and again.
    gc.collect()
    gc.freeze()
    pipe.send(asyncio.run(run_load(load, target, starts_at)))


async def run_load(load: Load, target: Target, starts_at: float) -> list[Exchange]:
    """Run a load in this process; ``starts_at`` is on `time.monotonic`'s clock."""
    async with connected(target) as http:
        return await load.run(Sender(http, target.timeout_s, starts_at))
