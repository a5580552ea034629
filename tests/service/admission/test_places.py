from __future__ import annotations

import asyncio
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.service.admission.places import MAX_WAIT_S, Admission, Full, whole_seconds


@dataclass
class Clock:
    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_n_counts_as_n() -> None:
    admission = Admission(draws=10, scenes=8, clock=Clock())
    with admission.place(6):
        with pytest.raises(Full, match="4 are free"), admission.place(5):
            pass
        with admission.place(4):
            assert admission.free == 0
            with pytest.raises(Full):
                admission.check_open()
        admission.check_open()
    assert admission.free == 10
    assert admission.places == ()


def test_alone_a_scene_may_be_larger() -> None:
    admission = Admission(draws=10, scenes=8, clock=Clock())
    with admission.place(40), pytest.raises(Full, match="0 are free"), admission.place(1):
        pass
    with admission.place(1), pytest.raises(Full), admission.place(40):
        pass


def test_scenes_are_bounded_too() -> None:
    admission = Admission(draws=100, scenes=2, clock=Clock())
    with admission.place(1), admission.place(1), pytest.raises(Full, match="2 scenes"), admission.place(1):
        pass


def test_a_place_waits_until_the_engine_begins() -> None:
    admission = Admission(draws=10, scenes=8, clock=Clock())
    with admission.place(3) as place:
        assert list(admission.waiting) == [place]
        place.began()
        assert not admission.waiting
        assert list(admission.places) == [place]


def test_it_says_when_to_come_back() -> None:
    clock = Clock()
    admission = Admission(draws=6, scenes=8, clock=clock)
    for _ in range(100):
        with admission.place(6):
            clock.now_s += 12.0  # six draws in 12 s: one every 2 s
    with admission.place(6), pytest.raises(Full) as full, admission.place(2):
        pass
    assert full.value.retry_after_s == pytest.approx(4.0, rel=0.01)
    assert whole_seconds(full.value.retry_after_s) == 4
    assert whole_seconds(0.01) == 1


def test_a_batch_takes_its_turns_in_order() -> None:
    async def test() -> list[int]:
        admission = Admission(draws=4, scenes=8, clock=Clock())
        began: list[int] = []

        async def scene(number: int, draws: int) -> None:
            async with admission.place_in_turn(draws):
                began.append(number)
                assert admission.free >= 0
                await asyncio.sleep(0)

        await asyncio.gather(*(scene(number, draws) for number, draws in enumerate((3, 4, 1, 2, 4, 1))))
        assert admission.free == 4
        return began

    assert asyncio.run(test()) == list(range(6))


def test_leaving_the_queue_frees_the_turn() -> None:
    async def test() -> None:
        admission = Admission(draws=2, scenes=8, clock=Clock())

        async def scene() -> None:
            async with admission.place_in_turn(2):
                pass

        with admission.place(2):
            first, second = asyncio.create_task(scene()), asyncio.create_task(scene())
            await asyncio.sleep(0)
            first.cancel()
            await asyncio.gather(first, return_exceptions=True)
        await second
        assert admission.free == 2

    asyncio.run(test())


@given(st.lists(st.tuples(st.integers(1, 9), st.booleans(), st.integers(0, 5)), max_size=30))
def test_never_more_than_there_is_and_all_comes_back(
    scenes: list[tuple[int, bool, int]],
) -> None:
    async def test() -> None:
        admission = Admission(draws=8, scenes=3, clock=Clock())

        async def scene(draws: int, batch: bool, steps: int) -> None:
            if batch:
                async with admission.place_in_turn(draws):
                    await hold(steps)
            else:
                try:
                    with admission.place(draws):
                        await hold(steps)
                except Full:
                    pass

        async def hold(steps: int) -> None:
            for _ in range(steps):
                held = sum(place.draws for place in admission.places)
                assert held <= 8 or len(admission.places) == 1
                assert len(admission.places) <= 3
                await asyncio.sleep(0)

        tasks = [asyncio.create_task(scene(*each)) for each in scenes]
        await asyncio.sleep(0)
        for task in tasks[::4]:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        assert admission.free == 8

    asyncio.run(test())


def test_batches_are_bounded_together() -> None:
    admission = Admission(draws=10, scenes=8, clock=Clock())
    with admission.batch(64), pytest.raises(Full, match="64 of others"), admission.batch(1):
        pass
    with admission.batch(5), admission.batch(3):
        with pytest.raises(Full):
            admission.check_open(batch=True)
        admission.check_open()
    with admission.batch(8):
        pass


def test_a_batch_gets_on_although_others_keep_coming() -> None:
    async def test() -> None:
        clock = Clock()
        admission = Admission(draws=4, scenes=8, clock=clock)
        began = asyncio.Event()

        async def scene() -> None:
            async with admission.place_in_turn(4) as place:
                assert place.waited_s == pytest.approx(MAX_WAIT_S + 0.1)
                began.set()

        with admission.place(1):
            task = asyncio.create_task(scene())
            await asyncio.sleep(0)
            assert [place.draws for place in admission.waiting] == [1, 4]
            with admission.place(3):
                clock.now_s += MAX_WAIT_S + 0.1
            # There is room for another, but the batch's scene has waited for long enough.
            with pytest.raises(Full, match="goes first"):
                admission.check_open()
        await asyncio.wait_for(began.wait(), 1)
        await task
        admission.check_open()

    asyncio.run(test())
