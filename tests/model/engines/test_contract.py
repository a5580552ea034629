"""One contract for all engines; vLLM's run of it is in `tests/model/engines/vllm`."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.engine import Engine, EngineError, RequestError
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.engines.transformers.engine import TransformersEngine
from tests.checkpoints import write_shaken
from tests.model.engines.contract import (
    CONTRACT,
    TELLING,
    Check,
    asked,
    new_weights_are_taken_between_requests,
    plan,
    weights_of_another_network_are_refused,
)
from tests.service.scripted_engine import ScriptedEngine

SCENE = next(iter(read_scenes(SCENES))).scene
ENGINES: dict[str, Callable[[Path], Engine]] = {
    "torch": lambda folder: TorchEngine(folder, TorchSettings(rows=8, products=None)),
    "transformers": TransformersEngine,
}


@pytest.fixture(scope="module", params=ENGINES)
def engine(request: pytest.FixtureRequest, loop: asyncio.AbstractEventLoop) -> Iterator[Engine]:
    engine = ENGINES[request.param](CHECKPOINT)
    loop.run_until_complete(engine.start())
    yield engine
    loop.run_until_complete(engine.stop())


@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
def test_the_contract(loop: asyncio.AbstractEventLoop, engine: Engine, check: Check) -> None:
    loop.run_until_complete(check(engine, SCENE))


def test_new_weights(
    loop: asyncio.AbstractEventLoop, engine: Engine, untrained_checkpoint: Path, tmp_path: Path
) -> None:
    other, fresh = write_shaken(tmp_path / "shaken", CHECKPOINT), ENGINES[engine.card.engine]
    loop.run_until_complete(new_weights_are_taken_between_requests(engine, SCENE, CHECKPOINT, other, fresh))
    loop.run_until_complete(weights_of_another_network_are_refused(engine, SCENE, untrained_checkpoint))


def test_an_engine_that_does_not_run_takes_no_weights(loop: asyncio.AbstractEventLoop) -> None:
    for make in ENGINES.values():
        with pytest.raises(EngineError, match="not running"):
            loop.run_until_complete(make(CHECKPOINT).load_weights(CHECKPOINT))


@pytest.mark.parametrize("check", TELLING, ids=lambda check: check.__name__)
def test_the_scripted_engine_tells_as_others_do(loop: asyncio.AbstractEventLoop, check: Check) -> None:
    loop.run_until_complete(check(ScriptedEngine(), SCENE))


def test_the_engines_write_the_same(loop: asyncio.AbstractEventLoop) -> None:
    async def drawn(engine: Engine) -> list[str]:
        await engine.start()
        try:
            return [draw.text for draw in await plan(engine, asked(engine, "same", SCENE, n=3, seed=3))]
        finally:
            await engine.stop()

    one, other = (loop.run_until_complete(drawn(make(CHECKPOINT))) for make in ENGINES.values())
    assert one == other


def test_an_engine_without_drafts_refuses_deadlines(loop: asyncio.AbstractEventLoop) -> None:
    async def test() -> None:
        engine = TransformersEngine(CHECKPOINT)
        await engine.start()
        try:
            with pytest.raises(RequestError, match="deadline_ms needs the torch engine"):
                await plan(engine, asked(engine, "late", SCENE, deadline_ms=300))
        finally:
            await engine.stop()

    loop.run_until_complete(test())
