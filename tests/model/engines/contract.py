"""What every engine has to do. Each check takes an engine that runs, and a scene that it can see."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from looktwice.model.driving.images import ImageError
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene import Clip, Scene
from looktwice.model.engines.engine import (
    Controls,
    Draw,
    DrawFinished,
    Engine,
    EngineError,
    Event,
    PlanRequest,
    RequestError,
    SectionFinished,
    Started,
    TextWritten,
)
from looktwice.model.families.registry import family_named
from looktwice.model.network.card import CheckpointError

Check = Callable[[Engine, Scene], Awaitable[None]]
GIVEN: Final = parse_plan("- longitudinal\n  - 0.0s-2.5s: Keep Speed\n  - 2.5s-6.4s: Accelerate\n")


async def events_of(engine: Engine, request: PlanRequest) -> list[Event]:
    return [event async for event in engine.submit(request)]


async def plan(engine: Engine, request: PlanRequest) -> list[Draw]:
    """The draws of a request, in order."""
    draws = [event.draw for event in await events_of(engine, request) if isinstance(event, DrawFinished)]
    return sorted(draws, key=lambda draw: draw.index)


def asked(engine: Engine, name: str, scene: Scene, *, live: bool = False, **controls: Any) -> PlanRequest:
    """A request in the engine's first format, which plans and may look twice."""
    return PlanRequest(name, scene, engine.card.default_format, Controls(**controls), live=live)


async def what_a_draw_says_is_told_before_it(engine: Engine, scene: Scene) -> None:
    events = await events_of(engine, asked(engine, "told", scene, n=2, thinking="always", live=True))
    assert isinstance(events[0], Started)
    assert sorted(event.draw.index for event in events if isinstance(event, DrawFinished)) == [0, 1]
    for index in range(2):
        [end] = [
            k
            for k, event in enumerate(events)
            if isinstance(event, DrawFinished) and event.draw.index == index
        ]
        finished = events[end]
        assert isinstance(finished, DrawFinished)
        told: dict[str, tuple[Any, ...]] = {}
        for place, event in enumerate(events):
            if isinstance(event, SectionFinished | TextWritten) and event.index == index:
                assert place < end
            if isinstance(event, SectionFinished) and event.index == index:
                told[event.section] = event.values
        family = family_named(engine.card.default_format)
        assert told[str(family.first_plan)] == (finished.draw.plan,)
        assert told[str(family.revised_plan)] == (finished.draw.revised_plan,)


async def the_branch_is_the_callers(engine: Engine, scene: Scene) -> None:
    for thinking, looked in (("always", True), ("never", False)):
        draws = await plan(engine, asked(engine, f"{thinking} thinks", scene, n=2, thinking=thinking))
        assert [draw.looked_twice for draw in draws] == [looked, looked]
        assert all(0.0 <= (draw.think_probability or 0.0) <= 1.0 for draw in draws)
    for threshold, looked in ((0.0, True), (1.0, False)):
        [draw] = await plan(engine, asked(engine, "threshold", scene, n=1, think_threshold=threshold))
        assert draw.looked_twice == looked


async def the_prompt_is_counted(engine: Engine, scene: Scene) -> None:
    request = asked(engine, "counted", scene, n=1)
    assert engine.prompt_tokens(replace(request, scene=replace(scene, route=None))) > 0
    assert engine.prompt_tokens(replace(request, scene=replace(scene, route=None))) <= engine.prompt_tokens(
        request
    )


async def a_given_plan_is_kept(engine: Engine, scene: Scene) -> None:
    [draw] = await plan(engine, asked(engine, "given", scene, n=1, prefill=GIVEN, thinking="never"))
    assert draw.plan == GIVEN


async def the_same_seed_draws_the_same(engine: Engine, scene: Scene) -> None:
    # Times and codes of least expected error do not depend on the seed, and a model may be sure of its words.
    drawn: dict[str, Any] = {"numbers": "drawn", "codes": "drawn", "temperature": 2.0}
    first, again, other = [
        await plan(engine, asked(engine, "seed", scene, n=3, seed=seed, logprobs=True, **drawn))
        for seed in (7, 7, 8)
    ]
    for one, two in zip(first, again, strict=True):
        assert (one.text, one.ids) == (two.text, two.ids)
        assert one.trajectory.shape == (len(family_named(engine.card.default_format).times_s), 4)
        assert len(one.logprobs) == len(one.ids)
        assert all(logprob is None or logprob <= 0 for logprob in one.logprobs)
    assert any(
        not np.array_equal(one.trajectory, two.trajectory) for one, two in zip(first, other, strict=True)
    )


async def who_leaves_early_frees_the_engine(engine: Engine, scene: Scene) -> None:
    async for _ in (events := engine.submit(asked(engine, "early", scene, n=2, thinking="always"))):
        break
    await events.aclose()
    assert len(await plan(engine, asked(engine, "early", scene, n=1))) == 1
    assert engine.load.rows_used == 0


async def cancelling_tells_who_waits(engine: Engine, scene: Scene) -> None:
    waiting = asyncio.create_task(plan(engine, asked(engine, "slow", scene, n=4, thinking="always")))
    while not engine.load.rows_used:
        await asyncio.sleep(0.001)
    engine.cancel("slow")
    engine.cancel("unknown")
    with pytest.raises(EngineError, match="cancelled"):
        await waiting
    assert len(await plan(engine, asked(engine, "slow", scene, n=1))) == 1


async def bad_requests_fail_alone(engine: Engine, scene: Scene) -> None:
    # The engine's second format has no branch.
    camera, plain = scene.clips[0].camera, engine.card.formats[1]
    damaged = replace(scene, clips=(Clip(camera, (b"\xff\xd8no",) * 4), *scene.clips[1:]))
    good = asyncio.create_task(plan(engine, asked(engine, "good", scene, n=2)))
    await asyncio.sleep(0)
    for bad, message in (
        (asked(engine, "good", scene), "in use"),
        (asked(engine, "a", damaged), "picture"),
        *(
            [(asked(engine, "b", replace(scene, clips=scene.clips[1:])), f"lacks camera {camera}")]
            if engine.card.cameras
            else []
        ),
        (PlanRequest("c", scene, "nobody"), "unknown format"),
        (asked(engine, "d", scene, imagine="always"), "imagine no pictures"),
        (
            PlanRequest("e", scene, plain, Controls(thinking="always")),
            "thinking: .* cannot be asked for always; ask for adaptive",
        ),
        (PlanRequest("f", scene, plain, Controls(think_threshold=0.5)), "have no branch"),
    ):
        with pytest.raises((RequestError, ImageError), match=message):
            await plan(engine, bad)
    assert len(await good) == 2


async def who_stops_is_told_and_may_start_again(engine: Engine, scene: Scene) -> None:
    # Enough work that some is left when a busy machine comes to the stop late.
    slow = (plan(engine, asked(engine, f"slow-{each}", scene, n=4, thinking="always")) for each in range(8))
    waiting = asyncio.gather(*slow)
    while not engine.load.rows_used:
        await asyncio.sleep(0.001)
    watching = asyncio.create_task(engine.wait())
    await engine.stop()
    with pytest.raises(EngineError, match="stopped"):
        await waiting
    await watching
    with pytest.raises(EngineError, match="not running"):
        await plan(engine, asked(engine, "late", scene, n=1))
    await engine.start()
    assert len(await plan(engine, asked(engine, "again", scene, n=1))) == 1


async def new_weights_are_taken_between_requests(
    engine: Engine, scene: Scene, first: Path, other: Path, fresh: Callable[[Path], Engine]
) -> None:
    """Nothing is left of the old ones, nor, when these are back, of the new ones.

    Args:
        engine: runs.
        scene: that it can see.
        first: its checkpoint folder.
        other: a checkpoint folder that differs in its weights alone.
        fresh: makes such an engine over a folder.
    """
    revision = engine.card.revision

    def greedy(name: str) -> PlanRequest:
        return asked(engine, name, scene, n=2, thinking="always", temperature=0.0, prefill=GIVEN)

    async def drawn(name: str, by: Engine = engine) -> list[str]:
        return [draw.text for draw in await plan(by, greedy(name))]

    old = await drawn("old")
    under_way = engine.submit(greedy("under way"))
    assert isinstance(await anext(under_way), Started)
    taking = asyncio.create_task(engine.load_weights(other))
    await asyncio.sleep(0)
    behind = asyncio.create_task(drawn("behind"))
    assert [event.draw.text async for event in under_way if isinstance(event, DrawFinished)] == old
    await taking
    new = await drawn("new")
    assert new != old
    assert await behind == new
    another = fresh(other)
    assert engine.card == another.card
    assert engine.card.revision != revision
    await another.start()
    try:
        assert await drawn("fresh", another) == new
    finally:
        await another.stop()
    await engine.load_weights(first)
    assert engine.card.revision == revision
    assert await drawn("old again") == old


async def weights_of_another_network_are_refused(engine: Engine, scene: Scene, unlike: Path) -> None:
    before, card = await plan(engine, asked(engine, "before", scene, n=1)), engine.card
    for folder, message in (
        (unlike, "in its settings, tokenizer"),
        (unlike / "none", "not a LookTwice"),
    ):
        with pytest.raises(CheckpointError, match=message):
            await engine.load_weights(folder)
    assert engine.card == card
    [draw] = await plan(engine, asked(engine, "after", scene, n=1))
    assert draw.text == before[0].text


TELLING: Final[tuple[Check, ...]] = (
    what_a_draw_says_is_told_before_it,
    the_branch_is_the_callers,
    a_given_plan_is_kept,
    the_same_seed_draws_the_same,
)
"""What an engine tells of draws. The services' scripted engine does that much."""
CONTRACT: Final[tuple[Check, ...]] = (
    *TELLING,
    who_leaves_early_frees_the_engine,
    cancelling_tells_who_waits,
    bad_requests_fail_alone,
    the_prompt_is_counted,
    who_stops_is_told_and_may_start_again,
)
"""All of it; the last one starts the engine anew."""
