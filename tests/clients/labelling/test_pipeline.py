from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest

from looktwice.clients.labelling.concurrency import ConcurrencyLimit
from looktwice.clients.labelling.ledger import Ledger, Record
from looktwice.clients.labelling.pipeline import (
    CannotBeDone,
    Job,
    StageLimits,
    StageStopped,
    Tally,
    work_through,
)
from looktwice.clients.retries import TryLater


def jobs(count: int, first: int = 0) -> Iterator[Job[int]]:
    return (Job(f"key {number}", f"scene {number}", number) for number in range(first, first + count))


def worked(
    folder: Path,
    found: Iterator[Job[int]],
    do: Callable[[Job[int]], Awaitable[Record]],
    limits: StageLimits = StageLimits(at_once=8, give_up_after_s=5.0),
) -> Tally:
    with Ledger(folder) as ledger:
        run = ledger.run("rollout", {})
        return asyncio.run(work_through(ledger, run, found, do, limits))


async def square(job: Job[int]) -> Record:
    return {"square": job.subject**2}


def records(folder: Path) -> dict[str, Record]:
    with Ledger(folder) as ledger:
        return {entry.scene_id: entry.record for entry in ledger.entries(ledger.run("rollout", {}))}


def test_each_piece_is_done_once(tmp_path: Path) -> None:
    first = worked(tmp_path, jobs(30), square)
    assert (first.done, first.dead, first.earlier) == (30, 0, 0)
    again = worked(tmp_path, jobs(40), square)
    assert (again.done, again.earlier) == (10, 30)
    assert records(tmp_path) == {f"scene {number}": {"square": number**2} for number in range(40)}


def test_pieces_that_are_the_same_are_done_once(tmp_path: Path) -> None:
    twice = (job for job in (*jobs(5), *jobs(5)))
    tally = worked(tmp_path, twice, square)
    assert (tally.done, tally.earlier) == (5, 5)


def test_what_cannot_be_done_is_a_dead_letter_and_the_rest_goes_on(tmp_path: Path) -> None:
    async def refuse_one(job: Job[int]) -> Record:
        if job.subject == 3:
            raise CannotBeDone("the picture is broken", type="invalid-image")
        return await square(job)

    tally = worked(tmp_path, jobs(10), refuse_one)
    assert (tally.done, tally.dead) == (9, 1)
    with Ledger(tmp_path) as ledger:
        (dead,) = ledger.entries(ledger.run("rollout", {}), "dead")
    assert dead.record == {"reason": "the picture is broken", "type": "invalid-image"}


def test_too_many_errors_stop_it_and_nothing_is_lost(tmp_path: Path) -> None:
    async def refuse_half(job: Job[int]) -> Record:
        if job.subject % 2:
            raise CannotBeDone("no")
        return await square(job)

    with pytest.raises(StageStopped, match=r"of \d+ could not be done.*because: no"):
        worked(tmp_path, jobs(1000), refuse_half, StageLimits(at_once=4, max_error_rate=0.2))
    done = len(records(tmp_path))
    assert 5 <= done <= 40
    patient = worked(tmp_path, jobs(100), refuse_half, StageLimits(at_once=4, max_error_rate=1.0))
    assert len(records(tmp_path)) == 50 == done + patient.done


def test_where_there_was_nothing_to_be_done_it_goes_on(tmp_path: Path) -> None:
    async def silent(job: Job[int]) -> Record:
        raise CannotBeDone("nothing to say", fault=False)

    tally = worked(tmp_path, jobs(100), silent, StageLimits(at_once=4, max_error_rate=0.1))
    assert (tally.done, tally.dead) == (0, 100)


def test_so_many_more_are_begun_and_no_others(tmp_path: Path) -> None:
    worked(tmp_path, jobs(5), square)
    tally = worked(tmp_path, jobs(30), square, StageLimits(at_most=3))
    assert (tally.done, tally.earlier) == (3, 5)


def test_who_is_busy_is_asked_again(tmp_path: Path) -> None:
    asked: dict[int, int] = {}

    async def busy_at_first(job: Job[int]) -> Record:
        asked[job.subject] = asked.get(job.subject, 0) + 1
        if asked[job.subject] < 3:
            raise TryLater("busy", 0.001)
        return await square(job)

    tally = worked(tmp_path, jobs(20), busy_at_first)
    assert (tally.done, tally.dead) == (20, 0)
    assert set(asked.values()) == {3}


def test_who_never_answers_ends_it_in_time(tmp_path: Path) -> None:
    async def away(job: Job[int]) -> Record:
        raise TryLater("nobody there", 0.01)

    with pytest.raises(StageStopped, match="nobody there"):
        worked(tmp_path, jobs(5), away, StageLimits(give_up_after_s=0.1))
    assert records(tmp_path) == {}
    assert worked(tmp_path, jobs(5), square).done == 5


def test_one_that_fails_while_others_succeed_is_a_dead_letter(tmp_path: Path) -> None:
    async def one_is_cursed(job: Job[int]) -> Record:
        if job.subject == 3:
            raise TryLater("the engine failed", 0.01)
        return await square(job)

    tally = worked(tmp_path, jobs(20), one_is_cursed, StageLimits(give_up_after_s=0.1))
    assert (tally.done, tally.dead) == (19, 1)


def test_one_that_fails_in_the_midst_of_others_is_a_dead_letter(tmp_path: Path) -> None:
    async def one_is_cursed(job: Job[int]) -> Record:
        await asyncio.sleep(0.02)
        if job.subject == 3:
            raise TryLater("the engine failed", 0.01)
        return await square(job)

    tally = worked(tmp_path, jobs(400), one_is_cursed, StageLimits(at_once=4, give_up_after_s=0.4))
    assert (tally.done, tally.dead) == (399, 1)


def test_who_goes_away_in_the_midst_of_it_makes_no_dead_letters(tmp_path: Path) -> None:
    served = 0

    async def drained(job: Job[int]) -> Record:
        """Whatever is under way when it goes is still answered, and nothing after that."""
        nonlocal served
        if served > 30:
            raise TryLater("it is about to stop", 0.01)
        served += 1
        await asyncio.sleep(0.001 * (job.subject % 7))
        return await square(job)

    with pytest.raises(StageStopped, match="about to stop"):
        worked(tmp_path, jobs(200), drained, StageLimits(at_once=16, give_up_after_s=3.0))
    assert all("square" in record for record in records(tmp_path).values())
    served = -200
    tally = worked(tmp_path, jobs(200), drained)
    assert (tally.done + tally.earlier, tally.dead) == (200, 0)


def test_who_asks_for_a_longer_wait_than_there_is_time_ends_it_at_once(tmp_path: Path) -> None:
    async def limited(job: Job[int]) -> Record:
        if job.subject > 9:
            raise TryLater("come back in an hour", 3600.0)
        return await square(job)

    with pytest.raises(StageStopped, match="in an hour"):
        worked(tmp_path, jobs(200), limited)
    assert all("square" in record for record in records(tmp_path).values())


def test_a_defect_is_no_dead_letter(tmp_path: Path) -> None:
    async def broken(job: Job[int]) -> Record:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        worked(tmp_path, jobs(5), broken)
    assert worked(tmp_path, jobs(5), square).done == 5


def test_never_more_at_once_than_allowed(tmp_path: Path) -> None:
    inside, most = 0, 0

    async def counted(job: Job[int]) -> Record:
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        await asyncio.sleep(0.2)  # longer than it takes to begin the next one, on a busy machine too
        inside -= 1
        return await square(job)

    worked(tmp_path, jobs(100), counted, StageLimits(at_once=6))
    assert most == 6, "it grows up to what is allowed"


def test_a_crowd_shrinks_once_for_calls_that_were_refused_together() -> None:
    async def go() -> tuple[int, int]:
        concurrency = ConcurrencyLimit(16)
        for _ in range(200):
            async with concurrency.slot():
                pass
        full = concurrency.allowed
        gate = asyncio.Event()

        async def refused() -> None:
            try:
                async with concurrency.slot():
                    await gate.wait()
                    raise TryLater("busy")
            except TryLater:
                pass

        together = [asyncio.create_task(refused()) for _ in range(full)]
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        gate.set()
        await asyncio.gather(*together)
        return full, concurrency.allowed

    assert asyncio.run(go()) == (16, 8)
