from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.images import ImageError
from looktwice.model.driving.scene import Clip, Scene
from looktwice.model.engines.binding import Binding
from looktwice.model.engines.engine import (
    Controls,
    Draw,
    DrawFinished,
    EngineError,
    PlanRequest,
    RequestError,
    Started,
)
from looktwice.model.engines.torch.decoder import Decoder, StepEvent
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.evaluation.ladder import at_threshold
from looktwice.model.network.card import CheckpointError
from tests.checkpoints import noisy_scene
from tests.sockets import PATIENCE_S


def run(test: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(test(), 120))


@asynccontextmanager
async def running(checkpoint: Path, rows: int = 8) -> AsyncIterator[TorchEngine]:
    # In float32: where a CPU works in bfloat16, a batch may flip a draw.
    engine = TorchEngine(checkpoint, TorchSettings(rows=rows, products=None))
    await engine.start()
    try:
        yield engine
    finally:
        await engine.stop()


async def plan(engine: TorchEngine, request: PlanRequest) -> list[Draw]:
    draws = [event.draw async for event in engine.submit(request) if isinstance(event, DrawFinished)]
    return sorted(draws, key=lambda draw: draw.index)


def direct(name: str, scene: Scene | None = None, **controls: object) -> PlanRequest:
    return PlanRequest(name, scene or noisy_scene(), "traj_only", Controls(**controls))  # type: ignore[arg-type]


def test_a_checkpoint_that_is_refused_leaves_no_thread(tmp_path: Path) -> None:
    before = threading.active_count()
    with pytest.raises(CheckpointError):
        TorchEngine(tmp_path)
    assert threading.active_count() == before


def test_many_requests_at_once_get_what_they_get_alone(untrained_checkpoint: Path) -> None:
    async def test() -> None:
        async with running(untrained_checkpoint) as engine:
            requests = [direct(f"{k}", noisy_scene(k), n=2, seed=k) for k in range(10)]
            together = await asyncio.gather(*(plan(engine, request) for request in requests))
            for request, draws in zip(requests, together, strict=True):
                alone = await plan(engine, request)
                assert [draw.codes for draw in alone] == [draw.codes for draw in draws]
                assert [draw.index for draw in draws] == [0, 1]
                assert np.isfinite([draw.trajectory for draw in draws]).all()

    run(test)


def test_every_threshold_is_told_from_never_and_always_thinking(untrained_checkpoint: Path) -> None:
    async def test() -> None:
        async with running(untrained_checkpoint) as engine:

            async def draws(**controls: object) -> list[Draw]:
                asked = Controls(n=6, seed=3, **controls)  # type: ignore[arg-type]
                return await plan(engine, PlanRequest(str(controls), noisy_scene(), "cf_vla", controls=asked))

            never, always = await draws(thinking="never"), await draws(thinking="always")
            probabilities = sorted(draw.think_probability or 0.0 for draw in never)
            for threshold in (0.0, (probabilities[2] + probabilities[3]) / 2, 1.0):
                thresholded = await draws(think_threshold=threshold)
                told = at_threshold(never, always, threshold)
                assert [draw.text for draw in told] == [draw.text for draw in thresholded]

    run(test)


def test_leaving_early_frees_the_rows(untrained_checkpoint: Path) -> None:
    async def test() -> None:
        async with running(untrained_checkpoint, rows=2) as engine:
            waiting = PlanRequest("slow", noisy_scene(), "cf_vla", controls=Controls(n=2, thinking="always"))
            async for _ in (events := engine.submit(waiting)):
                break
            passes = engine.counts.passes
            await events.aclose()
            await asyncio.sleep(0.5)
            # The step that was under way, and the one in which it was told.
            assert engine.counts.passes - passes <= 2
            assert engine.load.rows_used == 0
            assert len(await plan(engine, direct("next", n=2))) == 2

    run(test)


def test_a_request_never_gets_the_draws_of_one_that_had_its_name(
    untrained_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded, asked_again, plain = threading.Event(), threading.Event(), Decoder.step

    def held_up(self: Decoder) -> list[StepEvent]:
        events = plain(self)
        if any(name == "name" and isinstance(event, DrawFinished) for name, event in events):
            decoded.set()
            asked_again.wait(PATIENCE_S)
        return events

    async def test() -> None:
        async with running(untrained_checkpoint, rows=4) as engine:
            monkeypatch.setattr(Decoder, "step", held_up)
            slow = PlanRequest("name", noisy_scene(), "cf_vla", Controls(n=1, thinking="always"))
            events = engine.submit(slow)
            assert isinstance(await anext(events), Started)
            while not decoded.is_set():
                await asyncio.sleep(0.001)
            await events.aclose()
            again = asyncio.create_task(plan(engine, direct("name", n=1, seed=1)))
            await asyncio.sleep(0.05)
            asked_again.set()
            [draw] = await again
            [expected] = await plan(engine, direct("other", n=1, seed=1))
            assert draw.ids == expected.ids

    run(test)


def test_an_engine_that_has_started_has_planned_in_every_format(untrained_checkpoint: Path) -> None:
    async def test() -> None:
        async with running(untrained_checkpoint) as engine:
            assert engine.counts.scene_passes > 0
            assert engine.counts.passes > len(engine.card.formats)
            assert engine.load.rows_used == 0

    run(test)


def test_bad_requests_fail_alone(untrained_checkpoint: Path) -> None:
    scene = noisy_scene()
    damaged = Scene(
        "damaged", (Clip(scene.clips[0].camera, (b"\xff\xd8no",) * 4), scene.clips[1]), scene.history
    )
    one_eyed = Scene("one-eyed", scene.clips[:1], scene.history)

    async def test() -> None:
        async with running(untrained_checkpoint) as engine:
            good = asyncio.create_task(plan(engine, direct("good", n=2)))
            for bad, message in (
                (direct("a", damaged), "picture"),
                (direct("b", one_eyed), "lacks camera front_tele_30"),
                (direct("c", n=9), "at most 8 draws"),
            ):
                with pytest.raises((RequestError, ImageError), match=message):
                    await plan(engine, bad)
            assert len(await good) == 2

    run(test)


def test_an_id_is_used_once_at_a_time(untrained_checkpoint: Path) -> None:
    async def test() -> None:
        async with running(untrained_checkpoint) as engine:
            first = asyncio.create_task(plan(engine, direct("same", n=4)))
            await asyncio.sleep(0)
            with pytest.raises(RequestError, match="in use"):
                await plan(engine, direct("same"))
            assert len(await first) == 4

    run(test)


def test_cancelling_by_name_tells_who_waits(untrained_checkpoint: Path) -> None:
    async def test() -> None:
        async with running(untrained_checkpoint, rows=2) as engine:
            request = PlanRequest("slow", noisy_scene(), "cf_vla", controls=Controls(n=2, thinking="always"))
            waiting = asyncio.create_task(plan(engine, request))
            await asyncio.sleep(0.05)
            engine.cancel("slow")
            engine.cancel("unknown")
            with pytest.raises(EngineError, match="cancelled"):
                await waiting
            assert len(await plan(engine, direct("next", n=2))) == 2

    run(test)


def test_a_deadline_counts_from_submission(
    untrained_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not from the end of the step that the thread is in the middle of."""
    step, add = Decoder.step, Decoder.add
    in_step, go_on, submitted_s = threading.Event(), threading.Event(), dict[str, float]()

    def long_step(decoder: Decoder) -> list[StepEvent]:
        in_step.set()
        go_on.wait(60)
        return step(decoder)

    def noted(
        decoder: Decoder,
        request: PlanRequest,
        stamp_s: float,
        binding: Binding | None,
    ) -> None:
        submitted_s[request.request_id] = stamp_s
        add(decoder, request, stamp_s, binding)

    async def test() -> None:
        async with running(untrained_checkpoint) as engine:
            monkeypatch.setattr(Decoder, "step", long_step)
            monkeypatch.setattr(Decoder, "add", noted)
            first = asyncio.create_task(plan(engine, direct("first", n=1)))
            assert await asyncio.to_thread(in_step.wait, 60)
            second = asyncio.create_task(plan(engine, direct("second", n=1)))
            await asyncio.sleep(0.01)
            before_its_end_s = time.monotonic()
            go_on.set()
            await asyncio.gather(first, second)
            assert submitted_s["second"] <= before_its_end_s

    run(test)


def test_stopping_tells_those_who_wait(untrained_checkpoint: Path) -> None:
    async def test() -> None:
        async with running(untrained_checkpoint) as engine:
            request = PlanRequest("slow", noisy_scene(), "cf_vla", controls=Controls(n=8, thinking="always"))
            waiting = asyncio.create_task(plan(engine, request))
            await asyncio.sleep(0.05)
            await engine.stop()
            with pytest.raises(EngineError, match="stopped"):
                await waiting
            with pytest.raises(EngineError, match="not running"):
                await plan(engine, direct("late"))

    run(test)


def test_an_engine_that_broke_says_so_and_can_be_started_again(
    untrained_checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = Runner.feed

    def out_of_memory(runner: Runner, feeds: object) -> object:
        raise torch.OutOfMemoryError("no room for this batch")

    async def test() -> None:
        async with running(untrained_checkpoint) as engine:
            broken = asyncio.create_task(engine.wait())
            monkeypatch.setattr(Runner, "feed", out_of_memory)
            with pytest.raises(EngineError, match="no room for this batch"):
                await plan(engine, direct("doomed", n=2))
            with pytest.raises(EngineError, match="no room for this batch"):
                await broken
            with pytest.raises(EngineError, match="not running"):
                await plan(engine, direct("late"))
            await engine.stop()
            monkeypatch.setattr(Runner, "feed", feed)
            await engine.start()
            assert len(await plan(engine, direct("after", n=2))) == 2
            assert engine.load.rows_used == 0

    run(test)


def test_who_stops_watching_does_not_disturb_the_engine(untrained_checkpoint: Path) -> None:
    async def test() -> None:
        async with running(untrained_checkpoint) as engine:
            watching = asyncio.create_task(engine.wait())
            await asyncio.sleep(0)
            watching.cancel()
            assert len(await plan(engine, direct("after", n=2))) == 2
            watching = asyncio.create_task(engine.wait())
            await engine.stop()
            await watching

    run(test)
