"""When requests are due, who sends them (open or closed loop), and the processes that do it."""

from __future__ import annotations

import asyncio
import gc
import math
import multiprocessing
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Final, Protocol, Self

import numpy as np
import numpy.typing as npt

from looktwice.loadtests.exchange import MISSED, Call, Exchange
from looktwice.loadtests.sending import Sender, ServiceTarget, connected

Times = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LoadPhase:
    """A stretch of a run.

    Attributes:
        name: as it is called in the report.
        seconds: how long it lasts.
        rate_rps: requests offered per second, on average.
    """

    name: str
    seconds: float
    rate_rps: float

    def __post_init__(self) -> None:
        if self.seconds < 0 or self.rate_rps < 0:
            raise ValueError(f"phase {self.name}: neither time nor rate can be negative")


@dataclass(frozen=True)
class Window:
    """A phase on the clock of its run: ``start_s`` <= t < ``end_s``."""

    name: str
    start_s: float
    end_s: float

    @property
    def seconds(self) -> float:
        """How long it is."""
        return self.end_s - self.start_s


def windows(phases: Sequence[LoadPhase]) -> list[Window]:
    """Where each phase lies, one behind the other from 0 on."""
    ends = np.cumsum([phase.seconds for phase in phases]).tolist()
    return [Window(phase.name, end - phase.seconds, end) for phase, end in zip(phases, ends, strict=True)]


def poisson_arrivals(phases: Sequence[LoadPhase], seed: int) -> Times:
    """Seconds from the run's start at which requests are due: float64 [k], ascending.

    A Poisson process of a constant rate is a Poisson number of times spread evenly at random.
    """
    random = np.random.default_rng(seed)
    due = [
        window.start_s
        + np.sort(random.uniform(0, phase.seconds, random.poisson(phase.rate_rps * phase.seconds)))
        for phase, window in zip(phases, windows(phases), strict=True)
    ]
    return np.concatenate(due) if due else np.empty(0)


class Load(Protocol):
    """Work that can be shared between processes."""

    def split(self, parts: int) -> list[Self]:
        """The same work as so many loads that run side by side."""
        ...

    async def run(self, sender: Sender) -> list[Exchange]:
        """All exchanges, once the last one has ended."""
        ...


@dataclass(frozen=True)
class OpenLoop:
    """Requests are sent when they are due, whether or not earlier ones were answered.

    Attributes:
        due_s: float64 [k], ascending; seconds from the run's start.
        calls: sent one after the other, and again from the first one when there are less than k.
        first: place of the first call.
    """

    due_s: Times
    calls: tuple[Call, ...] = field(repr=False)
    first: int = 0

    def split(self, parts: int) -> list[OpenLoop]:
        """Every so-manieth request each."""
        called = [self.calls[(self.first + place) % len(self.calls)] for place in range(len(self.due_s))]
        return [OpenLoop(self.due_s[part::parts], tuple(called[part::parts])) for part in range(parts)]

    async def run(self, sender: Sender) -> list[Exchange]:
        """See `Load`."""
        under_way = []
        for place, due_s in enumerate(self.due_s.tolist()):
            await sender.wait_until(due_s)
            call = self.calls[(self.first + place) % len(self.calls)]
            under_way.append(asyncio.create_task(sender.send(call, due_s)))
        return list(await asyncio.gather(*under_way))


@dataclass(frozen=True)
class PlanningCar:
    """A car that asks for a plan at every tick, unless it still waits for the one before.

    Attributes:
        calls: of its drive, tick by tick; the drive begins anew behind the last one.
        period_s: from tick to tick.
        offset_s: of the first tick.
    """

    calls: tuple[Call, ...] = field(repr=False)
    period_s: float
    offset_s: float

    async def run(self, sender: Sender, seconds: float) -> list[Exchange]:
        """Its exchanges; ticks that went by while it waited are among them, as missed."""
        exchanges: list[Exchange] = []
        ticks = math.ceil((seconds - self.offset_s) / self.period_s)
        tick = 0
        while tick < ticks:
            due_s = self.offset_s + tick * self.period_s
            await sender.wait_until(due_s)
            call = self.calls[tick % len(self.calls)]
            exchange = await sender.send(call, due_s)
            exchanges.append(exchange)
            tick += 1
            while tick < ticks and (passed_s := self.offset_s + tick * self.period_s) <= exchange.ended_s:
                exchanges.append(Exchange(call.kind, passed_s, math.nan, exchange.ended_s, MISSED))
                tick += 1
        return exchanges


@dataclass(frozen=True)
class Fleet:
    """Planners side by side, for so many seconds."""

    planners: tuple[PlanningCar, ...]
    seconds: float

    def split(self, parts: int) -> list[Fleet]:
        """Every so-manieth planner each."""
        return [replace(self, planners=self.planners[part::parts]) for part in range(parts)]

    async def run(self, sender: Sender) -> list[Exchange]:
        """See `Load`."""
        drives = await asyncio.gather(*(planner.run(sender, self.seconds) for planner in self.planners))
        return [exchange for drive in drives for exchange in drive]


def fleet(drives: list[list[Call]], hz: float, seconds: float, seed: int) -> Fleet:
    """Planners at ``hz``, each with its own drive, whose ticks begin at random within the first period."""
    offsets = np.random.default_rng(seed).uniform(0, 1 / hz, len(drives)).tolist()
    return Fleet(
        tuple(
            PlanningCar(tuple(calls), 1 / hz, offset) for calls, offset in zip(drives, offsets, strict=True)
        ),
        seconds,
    )


_HEAD_START_S: Final = 0.2
"""From the last worker's word that it is ready until the run begins."""


class GeneratorDied(RuntimeError):
    """A process of the generator ended before its load did."""


class WorkerPool:
    """Worker processes for one run.

    ::

        with WorkerPool(load, target, workers=2) as crew:
            starts_at = crew.begin()   # time.monotonic() of the run's start
            exchanges = crew.finish()
    """

    def __init__(self, load: Load, target: ServiceTarget, workers: int) -> None:
        # Spawned: a fork would copy whatever threads the caller has.
        context = multiprocessing.get_context("spawn")
        self._crew: list[tuple[multiprocessing.process.BaseProcess, Connection[object, object]]] = []
        for part in load.split(workers):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(part, target, theirs), daemon=True)
            process.start()
            theirs.close()
            self._crew.append((process, ours))

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, *_: object) -> None:
        for process, pipe in self._crew:
            process.terminate()
            process.join()
            pipe.close()

    def begin(self) -> float:
        """Wait until all are ready, start them together, return when they start; raises `GeneratorDied`."""
        for _, pipe in self._crew:
            _told(pipe)
        starts_at = time.monotonic() + _HEAD_START_S
        for _, pipe in self._crew:
            pipe.send(starts_at)
        return starts_at

    def finish(self) -> list[Exchange]:
        """All exchanges, in the order they were due; raises `GeneratorDied`."""
        exchanges: list[Exchange] = []
        for _, pipe in self._crew:
            exchanges += _told(pipe)  # type: ignore[arg-type]
        return sorted(exchanges, key=lambda each: each.due_s)


def _told(pipe: Connection[object, object]) -> object:
    try:
        return pipe.recv()
    except EOFError:
        raise GeneratorDied("a worker process of the load generator died; its own output says why") from None


def _end_with_parent() -> None:
    """A generator that was killed must not go on sending: the next run would share the service with it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(load: Load, target: ServiceTarget, pipe: Connection[object, object]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pipe.send("ready")
    starts_at = pipe.recv()
    assert isinstance(starts_at, float)
    # What was prepared stays until the end: the collector need not look through it again and again.
    gc.collect()
    gc.freeze()
    pipe.send(asyncio.run(run_load(load, target, starts_at)))


async def run_load(load: Load, target: ServiceTarget, starts_at: float) -> list[Exchange]:
    """Run a load in this process; ``starts_at`` is on `time.monotonic`'s clock."""
    async with connected(target) as http:
        return await load.run(Sender(http, target.timeout_s, starts_at))
