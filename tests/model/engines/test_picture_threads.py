from __future__ import annotations

import asyncio
import math
import threading

import numpy as np
import pytest

from looktwice.model.driving.images import ImageError, decode_image, encode_jpeg
from looktwice.model.engines.engine import EngineError
from looktwice.model.engines.picture_threads import LARGE_PIXELS, THREADS, PictureThreads


def test_work_runs_on_threads_of_its_own_and_tells_how_long_it_waits() -> None:
    async def test() -> None:
        threads, go_on = PictureThreads(), threading.Event()
        assert threads.waiting_s == 0.0
        names: list[str] = []

        def work() -> int:
            names.append(threading.current_thread().name)
            assert go_on.wait(30)
            return 7

        tasks = [asyncio.create_task(threads.run(work)) for _ in range(THREADS + 1)]
        while len(names) < THREADS:
            await asyncio.sleep(0.01)
        assert threads.waiting_s > 0
        # What is stuck there is in nobody's way elsewhere.
        assert await asyncio.to_thread(lambda: 1) == 1
        go_on.set()
        assert await asyncio.gather(*tasks) == [7] * (THREADS + 1)
        assert threads.waiting_s == 0.0
        assert all(name.startswith("looktwice-pictures") for name in names)
        threads.close()

    asyncio.run(asyncio.wait_for(test(), 60))


def test_large_pictures_hold_up_no_small_ones() -> None:
    side = math.isqrt(LARGE_PIXELS // 2) + 1
    small, large = (encode_jpeg(np.zeros((rows, rows, 3), np.uint8)) for rows in (32, side))

    async def test() -> None:
        threads, go_on = PictureThreads(), threading.Event()
        begun: list[str] = []

        def stuck() -> None:
            begun.append("large")
            assert go_on.wait(30)

        tasks = [asyncio.create_task(threads.run(stuck, [large, large])) for _ in range(5)]
        while not begun:
            await asyncio.sleep(0.01)
        assert await threads.run(lambda: 7, [small, large]) == 7, "one large picture is not yet much"
        assert begun == ["large"], "one at a time"
        assert threads.waiting_s > 0, "what is worked on may be stuck"
        go_on.set()
        await asyncio.gather(*tasks)
        assert len(begun) == 5
        assert threads.waiting_s == 0.0
        with pytest.raises(ImageError):
            await threads.run(lambda: 7, [b"no picture"])
        threads.close()

    asyncio.run(asyncio.wait_for(test(), 60))


@pytest.mark.parametrize("ends", ["its caller leaves", "the threads are closed"])
def test_work_on_pictures_ends_with_who_waits_for_it(ends: str) -> None:
    picture = encode_jpeg(np.zeros((32, 32, 3), np.uint8))

    async def test() -> None:
        threads, begun, go_on = PictureThreads(), threading.Event(), threading.Event()
        outcomes: list[str] = []

        def work() -> None:
            decode_image(picture)
            begun.set()
            assert go_on.wait(30)
            try:
                decode_image(picture)
                outcomes.append("decoded")
            except ImageError as error:
                outcomes.append(str(error))

        task = asyncio.create_task(threads.run(work, [picture]))
        while not begun.is_set():
            await asyncio.sleep(0.01)
        if ends == "its caller leaves":
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        else:
            threads.close()
        go_on.set()
        while not outcomes:
            await asyncio.sleep(0.01)
        assert outcomes == ["nobody waits for the picture any more"]
        if ends == "its caller leaves":
            assert await threads.run(lambda: decode_image(picture).shape, [picture]) == (32, 32, 3)
        threads.close()

    asyncio.run(asyncio.wait_for(test(), 60))


def test_what_fails_is_told_and_what_waits_is_dropped_in_the_end() -> None:
    async def test() -> None:
        threads, go_on = PictureThreads(), threading.Event()

        def fail() -> None:
            raise ValueError("no")

        with pytest.raises(ValueError, match="no"):
            await threads.run(fail)
        tasks = [asyncio.create_task(threads.run(lambda: go_on.wait(30))) for _ in range(THREADS + 3)]
        await asyncio.sleep(0.05)
        threads.close()
        go_on.set()
        done = await asyncio.gather(*tasks, return_exceptions=True)
        assert [str(each) for each in done if isinstance(each, EngineError)] == ["the engine was stopped"] * 3
        assert threads.waiting_s == 0.0

    asyncio.run(asyncio.wait_for(test(), 60))
