"""The same request gets the same answer to the last bit, whatever else runs and whatever is known already."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from itertools import count

import pytest
import torch

from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.engine import Controls, Draw, DrawFinished, PlanRequest
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.engines.torch.layout import repeatable_bucket
from looktwice.model.engines.torch.packed import _Product
from looktwice.model.network.precision import bfloat16_is_fast, fast_dtype

_SCENES = [labelled.scene for labelled in read_scenes(SCENES)][:6]
_IDS = count()

Bytes = tuple[str, float | None, tuple[float | None, ...], bytes]


def bytes_of(draw: Draw) -> Bytes:
    return draw.text, draw.think_probability, draw.logprobs, draw.trajectory.tobytes()


@pytest.fixture(scope="module", params=["as it is by default", "without products in bfloat16"])
def settings(request: pytest.FixtureRequest) -> Iterator[TorchSettings]:
    default = TorchSettings(rows=48)
    if request.param == "as it is by default":
        yield default
    elif bfloat16_is_fast():
        yield replace(default, products=None)
    else:
        pytest.skip("that is the default here")


async def draws(engine: TorchEngine, number: int, n: int) -> list[Bytes]:
    controls = Controls(n=n, seed=number, logprobs=True)
    asked = PlanRequest(f"{next(_IDS)}", _SCENES[number], "cf_vla", controls)
    told = [event.draw async for event in engine.submit(asked) if isinstance(event, DrawFinished)]
    return [bytes_of(draw) for draw in sorted(told, key=lambda draw: draw.index)]


def test_a_draw_is_the_same_fresh_repeated_alone_and_in_a_crowd(settings: TorchSettings) -> None:
    async def in_turn(engine: TorchEngine, n: int) -> list[list[Bytes]]:
        return [await draws(engine, number, n) for number in range(len(_SCENES))]

    async def together(engine: TorchEngine, *counts: int) -> list[list[Bytes]]:
        numbers = range(len(_SCENES))
        return await asyncio.gather(*(draws(engine, k, counts[k % len(counts)]) for k in numbers))

    async def test() -> None:
        fresh, other = TorchEngine(CHECKPOINT, settings), TorchEngine(CHECKPOINT, settings)
        await fresh.start()
        await other.start()
        first = await in_turn(fresh, 6)
        assert await in_turn(fresh, 6) == first, "repeated"
        assert await in_turn(fresh, 3) == [each[:3] for each in first], "three of six"
        assert await together(fresh, 6) == first, "together"
        # In an engine that has never seen them, beside draws of which there are more or fewer.
        mixed = await together(other, 6, 1, 4)
        counts = [(6, 1, 4)[k % 3] for k in range(len(_SCENES))]
        assert mixed == [each[:kept] for each, kept in zip(first, counts, strict=True)], "others beside"
        await fresh.stop()
        await other.stop()

    asyncio.run(asyncio.wait_for(test(), 300))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("width", [256, 768])
@pytest.mark.parametrize("products", sorted({torch.float32, fast_dtype()}, key=str), ids=str)
def test_a_token_gets_the_same_in_a_pass_of_any_size(products: torch.dtype, width: int, threads: int) -> None:
    """Wherever it stands; the widths are those of the bundled model's products."""
    generator = torch.Generator().manual_seed(1)
    product = _Product(torch.randn(256, width, generator=generator).to(products), repeatable=True)
    states = torch.randn(512, width, generator=generator).to(products)
    least = repeatable_bucket(1)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        alone = torch.cat([product(states[place : place + least]) for place in range(0, 512, least)])
        for size in sorted({repeatable_bucket(tokens) for tokens in range(1, 513)}):
            assert torch.equal(product(states[:size]), alone[:size]), size
            assert torch.equal(product(states[3 : 3 + size]), alone[3 : 3 + size]), size
    finally:
        torch.set_num_threads(before)


def test_only_on_a_cpu_is_that_so_by_default() -> None:
    assert TorchSettings.on("cpu", 6).reproducible
    assert not TorchSettings.on("cuda", 6).reproducible
