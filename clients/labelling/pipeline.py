"""One stage of a build: many pieces of work, each done once, whatever happens meanwhile."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

from looktwice.clients.labelling.concurrency import ConcurrencyLimit
from looktwice.clients.labelling.ledger import Ledger, Record, StageRun
from looktwice.clients.retries import TryLater, with_retries

_Subject = TypeVar("_Subject")

ERRORS_COUNT_FROM: Final = 20
"""Pieces of work before a share of errors means anything."""


class CannotBeDone(Exception):
    """A piece of work that will never succeed; it becomes a dead letter.

    Attributes:
        fault: whether something went wrong; else there was nothing to be done.
        more: what else its dead letter says.
    """

    def __init__(self, reason: str, *, fault: bool = True, **more: Any) -> None:
        super().__init__(reason)
        self.fault, self.more = fault, more


class StageStopped(RuntimeError):
    """A stage that ended early; what is done is kept, and the same command goes on with the rest."""


@dataclass(frozen=True)
class StageLimits:
    """How a stage is run.

    Attributes:
        at_once: most pieces of work under way.
        give_up_after_s: that the other side may be away before the stage stops.
        max_error_rate: share of faults among what ended, beyond which the stage stops.
        at_most: pieces of work that are begun, those done earlier not counted; None for all.
    """

    at_once: int = 32
    give_up_after_s: float = 300.0
    max_error_rate: float = 0.1
    at_most: int | None = None

    def too_many(self, faults: int, ended: int) -> bool:
        """Whether so many faults among what ended stop a stage."""
        return ended >= ERRORS_COUNT_FROM and faults > self.max_error_rate * ended


@dataclass(frozen=True)
class Job(Generic[_Subject]):
    """A piece of work; ``key`` stands for all that decides its outcome."""

    key: str
    scene_id: str
    subject: _Subject


@dataclass
class Tally:
    """What a stage did this time, in how many seconds; ``earlier`` were there before."""

    done: int = 0
    dead: int = 0
    earlier: int = 0
    seconds: float = 0.0


async def work_through(
    ledger: Ledger,
    run: StageRun,
    jobs: Iterator[Job[_Subject]],
    do: Callable[[Job[_Subject]], Awaitable[Record]],
    limits: StageLimits = StageLimits(),
    on_progress: Callable[[Tally], None] = lambda _: None,
) -> Tally:
    """Do what the ledger does not have yet, several at once, and enter each outcome as it comes.

    Args:
        ledger: what is done.
        run: what the outcomes belong to.
        jobs: in any order; read as they are needed, on another thread.
        do: makes a record; may raise `TryLater` or `CannotBeDone`.
        limits: see there.
        on_progress: told after every piece of work.

    Raises:
        StageStopped: too many errors, or the other side is away for too long.
    """
    concurrency, tally, began_s = ConcurrencyLimit(limits.at_once), Tally(), time.monotonic()
    under_way: set[asyncio.Task[None]] = set()
    begun: set[str] = set()
    faults, all_begun = 0, False

    async def finish(job: Job[_Subject]) -> None:
        nonlocal faults
        done_before = done_halfway = tally.done
        halfway_s: float | None = None

        async def attempt() -> Record:
            nonlocal done_halfway, halfway_s
            try:
                async with concurrency.slot():
                    return await do(job)
            except TryLater:
                now_s = time.monotonic()
                halfway_s = halfway_s or now_s + limits.give_up_after_s / 2
                if now_s <= halfway_s:
                    done_halfway = tally.done
                raise

        try:
            record = await with_retries(attempt, limits.give_up_after_s)
        except CannotBeDone as error:
            ledger.dead_letter(run, job.key, job.scene_id, str(error), **error.more)
            tally.dead += 1
            faults += error.fault
        except TryLater as error:
            told = f"nothing came for {limits.give_up_after_s:g} s: {error}"
            # Whoever goes away still answers some that it had begun with, so only later ones show that it is
            # there; behind the last piece of all there are none.
            is_last = all_begun and len(under_way) == 1
            others_were_served = tally.done > (done_before if is_last else done_halfway)
            everybody_is_to_wait = error.wait_s is not None and error.wait_s > limits.give_up_after_s
            if everybody_is_to_wait or not others_were_served:
                raise StageStopped(told) from error
            ledger.dead_letter(run, job.key, job.scene_id, told)
            tally.dead += 1
            faults += 1
        else:
            ledger.finish(run, job.key, job.scene_id, record)
            tally.done += 1
        on_progress(tally)
        ended = tally.done + tally.dead
        if limits.too_many(faults, ended):
            raise StageStopped(
                f"{faults} of {ended} could not be done, the last one ({job.scene_id}) because: "
                f"{_last_reason(ledger, run)}"
            )

    async def collect(count: int) -> None:
        """Wait until at most ``count`` are under way; raises what one of them raised."""
        while len(under_way) > count:
            ended, _ = await asyncio.wait(under_way, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
                under_way.remove(task)

    try:
        while limits.at_most is None or len(begun) < limits.at_most:
            job = await asyncio.to_thread(next, jobs, None)
            if job is None:
                all_begun = True
                break
            if ledger.has(job.key) or job.key in begun:
                tally.earlier += 1
                on_progress(tally)
                continue
            begun.add(job.key)
            # One more than may run waits at the door, so that a place is taken as soon as it is free.
            await collect(concurrency.allowed)
            under_way.add(asyncio.create_task(finish(job)))
        await collect(0)
        tally.seconds = time.monotonic() - began_s
    finally:
        for task in under_way:
            task.cancel()
        await asyncio.gather(*under_way, return_exceptions=True)
    return tally


def _last_reason(ledger: Ledger, run: StageRun) -> str:
    latest = max(ledger.entries(run, "dead"), key=lambda entry: entry.ended_at)
    return str(latest.record["reason"])
