"""What a worker does: offer requests when they are due (open loop), or drive planners (closed loop)."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np

from loadtests.arrivals import Times
from loadtests.call import Call
from loadtests.exchange import MISSED, Exchange
from loadtests.sending import Sender


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
class Planner:
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

    planners: tuple[Planner, ...]
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
        tuple(Planner(tuple(calls), 1 / hz, offset) for calls, offset in zip(drives, offsets, strict=True)),
        seconds,
    )
