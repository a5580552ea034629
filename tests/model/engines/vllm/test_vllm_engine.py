"""Real vLLM (CPU build) over the bundled checkpoint, beside the torch engine."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np
import pytest
import torch

from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.images import ImageError
from looktwice.model.driving.phrases import read_facts
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene import FRONT_WIDE, Clip, Scene
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.tracks import Track
from looktwice.model.engines.engine import (
    Controls,
    Decision,
    Draw,
    DrawFinished,
    Engine,
    EngineError,
    Event,
    PlanRequest,
    Reasons,
    RequestError,
    SectionFinished,
    Started,
    TextWritten,
    Thinking,
)
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.engines.vllm.engine import VllmEngine, VllmSettings
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.registry import families_of
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.replay import decisions
from looktwice.model.formats.text import parse
from looktwice.model.network.card import CheckpointError
from looktwice.model.network.checkpoint import load, read_parts
from looktwice.model.network.vla_settings import NANO_SETTINGS, VlaSettings
from looktwice.model.training.batches import collate
from looktwice.model.training.learner import ResponseLearner
from looktwice.model.training.outcome.rollouts import rollout
from tests.checkpoints import write_untrained
from tests.model.engines.contract import CONTRACT, Check

T = TypeVar("T")
Run = Callable[[Awaitable[T]], T]
BUNDLED = [labelled.scene for labelled in read_scenes(SCENES)]


@pytest.fixture(scope="module")
def vllm(loop: asyncio.AbstractEventLoop) -> Iterator[VllmEngine]:
    arguments = {"enforce_eager": True, "block_size": 32}
    engine = VllmEngine(CHECKPOINT, VllmSettings(rows=48, dtype="float32", arguments=arguments))
    loop.run_until_complete(engine.start())
    yield engine
    loop.run_until_complete(engine.stop())


@pytest.fixture(scope="module")
def torch_engine(loop: asyncio.AbstractEventLoop) -> Iterator[TorchEngine]:
    engine = TorchEngine(CHECKPOINT, TorchSettings(products=None))
    loop.run_until_complete(engine.start())
    yield engine
    loop.run_until_complete(engine.stop())


async def events_of(engine: Engine, request: PlanRequest) -> list[Event]:
    return [event async for event in engine.submit(request)]


async def plan(engine: Engine, request: PlanRequest) -> list[Draw]:
    events = await events_of(engine, request)
    draws = [event.draw for event in events if isinstance(event, DrawFinished)]
    return sorted(draws, key=lambda draw: draw.index)


async def plans(engine: Engine, requests: list[PlanRequest]) -> list[list[Draw]]:
    return await asyncio.gather(*(plan(engine, request) for request in requests))


def greedy(name: str, scene: Scene, **controls: Any) -> PlanRequest:
    # Behind vLLM only tracks tell what is in view.
    reasons: Reasons = "any" if scene.tracks is None else "in_view"
    return PlanRequest(name, scene, "cf_vla", Controls(n=1, temperature=0.0, reasons=reasons, **controls))


def mixed_scenes(count: int) -> list[Scene]:
    """Bundled pictures with histories and routes of other bundled scenes; every third without a route."""
    size = len(BUNDLED)
    return [
        replace(
            BUNDLED[k % size],
            scene_id=f"mixed-{k}",
            history=BUNDLED[(k + k // size) % size].history,
            route=None if k % 3 == 0 else BUNDLED[(k + k // size) % size].route,
        )
        for k in range(count)
    ]


def some_tracks(seed: int) -> tuple[Track, ...]:
    """Up to four cars."""
    numbers = np.random.default_rng(seed)
    return tuple(
        Track(float(x), float(y), 0.0, float(speed), 4.5, 1.9, kind="vehicle")
        for x, y, speed in numbers.uniform((-20, -8, 0), (60, 8, 15), (seed % 5, 3))
    )


def test_both_engines_write_the_same_at_temperature_0(
    loop: asyncio.AbstractEventLoop, vllm: VllmEngine, torch_engine: TorchEngine
) -> None:
    requests = [greedy(scene.scene_id, scene) for scene in mixed_scenes(108)]
    ours = loop.run_until_complete(plans(torch_engine, requests))
    theirs = loop.run_until_complete(plans(vllm, requests))
    parted = [
        f"{request.request_id}:\n{mine.text}\n{other.text}"
        for request, [mine], [other] in zip(requests, ours, theirs, strict=True)
        if mine.text != other.text
    ]
    assert not parted, "\n\n".join(parted)
    for [mine], [other] in zip(ours, theirs, strict=True):
        assert mine.codes == other.codes
        assert mine.tokens == other.tokens
        assert mine.think_probability is not None
        assert other.think_probability == pytest.approx(mine.think_probability, rel=1e-2, abs=1e-6)
        np.testing.assert_array_equal(mine.trajectory, other.trajectory)


def test_both_engines_write_the_same_with_a_resampler_and_tracks(
    loop: asyncio.AbstractEventLoop, tmp_path: Path
) -> None:
    """With and without tracks and a route, free text told live; vLLM ends before others use the cores."""
    nano = replace(NANO_SETTINGS, reflection="free_text", fine_vision=True)
    checkpoint = write_untrained(tmp_path / "free", settings=nano)
    arguments = {"enforce_eager": True, "block_size": 32}
    settings = VllmSettings(rows=8, dtype="float32", arguments=arguments)
    theirs = VllmEngine(checkpoint, settings)
    mine = TorchEngine(checkpoint, TorchSettings(products=None))
    scenes = [
        replace(scene, tracks=None if k % 3 == 1 else some_tracks(k))
        for k, scene in enumerate(mixed_scenes(48))
    ]
    requests = [greedy(scene.scene_id, scene) for scene in scenes]

    live = PlanRequest("live", scenes[0], "cf_vla", controls=Controls(n=2, thinking="always"), live=True)

    async def texts(engine: Engine) -> tuple[list[str], list[Event]]:
        await engine.start()
        try:
            draws = await plans(engine, requests)
            return [draw.text for [draw] in draws], await events_of(engine, live)
        finally:
            await engine.stop()

    written, events = loop.run_until_complete(texts(theirs))
    assert written == loop.run_until_complete(texts(mine))[0]
    for index in range(2):
        told = [event.text for event in events if isinstance(event, TextWritten) and event.index == index]
        [whole] = [
            event.text
            for event in events
            if isinstance(event, SectionFinished) and (event.index, event.section) == (index, "thinking")
        ]
        assert len(told) > 1
        assert whole == f"\n{''.join(told)}\n", "the free text alone, between what the format writes"
    assert len(set(written)) > 12


@pytest.mark.parametrize("thinking", ["always", "never"])
def test_the_branch_can_be_forced(
    loop: asyncio.AbstractEventLoop, vllm: VllmEngine, torch_engine: TorchEngine, thinking: str
) -> None:
    requests = [greedy(scene.scene_id, scene, thinking=thinking) for scene in mixed_scenes(8)]
    ours = loop.run_until_complete(plans(torch_engine, requests))
    theirs = loop.run_until_complete(plans(vllm, requests))
    assert [draw.text for [draw] in ours] == [draw.text for [draw] in theirs]
    assert {draw.branch for [draw] in theirs} == {"Thinking:" if thinking == "always" else "Action:"}
    assert all(draw.think_probability is not None for [draw] in theirs)


def test_reflections_state_only_what_the_tracks_tell(
    loop: asyncio.AbstractEventLoop, vllm: VllmEngine, torch_engine: TorchEngine
) -> None:
    tracked = [replace(scene, tracks=some_tracks(k)) for k, scene in enumerate(mixed_scenes(8))]
    requests = [greedy(f"tracked-{k}", scene, thinking="always") for k, scene in enumerate(tracked)]
    ours = loop.run_until_complete(plans(torch_engine, requests))
    theirs = loop.run_until_complete(plans(vllm, requests))
    assert [draw.text for [draw] in ours] == [draw.text for [draw] in theirs]
    for decision in ("least_error", "drawn"):
        controls = Controls(n=4, temperature=1.5, thinking="always", numbers=decision)
        asked = [
            PlanRequest(f"{decision}-{k}", scene, "cf_vla", controls=controls)
            for k, scene in enumerate(tracked)
        ]
        for draws in loop.run_until_complete(plans(vllm, asked)):
            for draw in draws:
                assert draw.thinking is not None
                assert draw.reasons is not None
                assert set(map(str, read_facts(draw.thinking).statements)) <= set(draw.reasons)


def test_the_threshold_decides(loop: asyncio.AbstractEventLoop, vllm: VllmEngine) -> None:
    scene = BUNDLED[0]
    [free] = loop.run_until_complete(plan(vllm, greedy("free", scene)))
    assert free.think_probability is not None
    below, above = free.think_probability * 0.5, min(1.0, free.think_probability * 2 + 1e-6)
    [thinks] = loop.run_until_complete(plan(vllm, greedy("below", scene, think_threshold=below)))
    [acts] = loop.run_until_complete(plan(vllm, greedy("above", scene, think_threshold=above)))
    assert (thinks.branch, acts.branch) == ("Thinking:", "Action:")
    assert thinks.thinking
    assert thinks.revised_plan is not None


def test_a_given_plan_is_kept(
    loop: asyncio.AbstractEventLoop, vllm: VllmEngine, torch_engine: TorchEngine
) -> None:
    given = parse_plan(
        "- longitudinal\n  - 0.0s-3.0s: Decelerate\n  - 3.0s-6.4s: Wait\n"
        "- lateral\n  - 0.0s-6.4s: Straight\n- lane\n  - 0.0s-6.4s: Keep Lane\n"
    )
    request = greedy("given", BUNDLED[1], prefill=given)
    events = loop.run_until_complete(events_of(vllm, request))
    sections = [event.section for event in events if isinstance(event, SectionFinished)]
    assert sections[:2] == ["plan", "branch"]
    [draw] = [event.draw for event in events if isinstance(event, DrawFinished)]
    assert draw.plan == given
    [mine] = loop.run_until_complete(plan(torch_engine, request))
    assert draw.text == mine.text


def test_greedy_draws_are_all_the_same(loop: asyncio.AbstractEventLoop, vllm: VllmEngine) -> None:
    """vLLM itself refuses several draws at temperature 0."""
    request = greedy("several", BUNDLED[1])
    several = replace(request, controls=replace(request.controls, n=3))
    draws = loop.run_until_complete(plan(vllm, several))
    [alone] = loop.run_until_complete(plan(vllm, replace(request, request_id="alone")))
    assert [draw.index for draw in draws] == [0, 1, 2]
    assert {draw.text for draw in draws} == {alone.text}


@pytest.mark.parametrize(("numbers", "different"), [("least_error", 2), ("drawn", 6)])
def test_draws_are_valid_and_repeat_with_their_seed(
    loop: asyncio.AbstractEventLoop, vllm: VllmEngine, numbers: Decision, different: int
) -> None:
    def request(name: str, seed: int) -> PlanRequest:
        controls = Controls(n=6, temperature=1.5, seed=seed, numbers=numbers)
        return PlanRequest(f"{numbers}-{name}", BUNDLED[3], "cf_vla", controls=controls)

    async def all_three() -> list[list[Draw]]:
        return [await plan(vllm, request(f"{k}", seed)) for k, seed in enumerate((3, 3, 4))]

    first, again, other = loop.run_until_complete(all_three())
    assert [draw.index for draw in first] == list(range(6))
    assert [draw.text for draw in first] == [draw.text for draw in again]
    assert [draw.text for draw in first] != [draw.text for draw in other]
    assert len({draw.text for draw in first}) >= different
    compiled = CompiledFormat(CF_VLA.format, read_parts(CHECKPOINT).vocabulary)
    for draw in first + other:
        assert parse(compiled, draw.text)["trajectory"] == draw.codes


@pytest.mark.parametrize("decision", ["least_error", "drawn"])
def test_decisions_are_as_likely_as_training_says(
    loop: asyncio.AbstractEventLoop, vllm: VllmEngine, decision: Decision
) -> None:
    controls = Controls(n=2, temperature=1.2, numbers=decision, codes=decision, logprobs=True)
    draws = loop.run_until_complete(
        plan(vllm, PlanRequest(f"likely {decision}", BUNDLED[0], "cf_vla", controls=controls))
    )
    loaded = load(CHECKPOINT)
    families = families_of(loaded.card.formats, loaded.settings.reflection)
    start = CompiledFormat(families["cf_vla"].format, loaded.vocabulary).start()
    replayed = [decisions(start, draw.ids) for draw in draws]
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec)
    batch = collate(rollout(BUNDLED[0], "cf_vla", draws, loaded.inputs))
    with torch.no_grad():
        found = learner.log_probabilities(batch, replayed, controls.temperature)
    for draw, made, logprobs in zip(draws, replayed, found, strict=True):
        assert sum(told is not None for told in draw.logprobs) == len(made)
        told = [draw.logprobs[each.position] for each in made]
        np.testing.assert_allclose(np.array(told, float), logprobs.numpy(), atol=1e-4)


@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
def test_the_contract(loop: asyncio.AbstractEventLoop, vllm: VllmEngine, check: Check) -> None:
    loop.run_until_complete(check(vllm, BUNDLED[3]))


def test_new_weights_are_refused(loop: asyncio.AbstractEventLoop, vllm: VllmEngine) -> None:
    with pytest.raises(CheckpointError, match="start an engine over it"):
        loop.run_until_complete(vllm.load_weights(CHECKPOINT))


def written_by_both(
    loop: asyncio.AbstractEventLoop, checkpoint: Path, requests: list[PlanRequest]
) -> tuple[list[Draw], list[Draw]]:
    """The first draws of requests, by vLLM and by the torch engine over the same checkpoint."""

    async def draws(engine: Engine) -> list[Draw]:
        await engine.start()
        try:
            return [draw for [draw] in await plans(engine, requests)]
        finally:
            await engine.stop()

    arguments = {"enforce_eager": True, "block_size": 32}
    theirs = VllmEngine(checkpoint, VllmSettings(rows=8, dtype="float32", arguments=arguments))
    written = loop.run_until_complete(draws(theirs))
    expected = loop.run_until_complete(draws(TorchEngine(checkpoint, TorchSettings(products=None))))
    return written, expected


def test_both_engines_write_the_same_in_a_family_of_ones_own(
    loop: asyncio.AbstractEventLoop, toy_family: None, tmp_path: Path
) -> None:
    """With numbers, repeats, codes of its own, and a branch of another name."""
    checkpoint = write_untrained(tmp_path / "toy", settings=VlaSettings(name="toy", formats=("toy",)))
    requests = [
        PlanRequest(f"{thinking}-{k}", scene, "toy", Controls(n=1, temperature=0.0, thinking=thinking))
        for k, scene in enumerate(mixed_scenes(6))
        for thinking in get_args(Thinking)
    ]
    written, expected = written_by_both(loop, checkpoint, requests)
    assert [draw.text for draw in written] == [draw.text for draw in expected]
    assert [draw.sections for draw in written] == [draw.sections for draw in expected]
    assert {draw.looked_twice for draw in written} == {True, False}


def test_both_engines_imagine_the_same(loop: asyncio.AbstractEventLoop) -> None:
    controls = [
        Controls(n=1, temperature=0.0, imagine="always", camera=FRONT_WIDE),
        Controls(n=1, temperature=0.0, imagine="always", camera="back", thinking="never"),
        Controls(n=1, temperature=0.0, imagine="never"),
    ]
    requests = [
        PlanRequest(f"{place}-{k}", scene, "vla_world", each)
        for k, scene in enumerate(BUNDLED[:2])
        for place, each in enumerate(controls)
    ]
    written, expected = written_by_both(loop, CHECKPOINT.parent / "world-nano", requests)
    pictures = [None if draw.foreseen is None else draw.foreseen.picture for draw in written]
    assert [picture and picture.camera for picture in pictures] == 2 * [FRONT_WIDE, "back", None]
    # Of two codes that are as likely within rounding, either may be the likelier one.
    same = [draw.text == other.text for draw, other in zip(written, expected, strict=True)]
    assert sum(same) >= len(same) - 1


def test_sections_come_before_their_draw(loop: asyncio.AbstractEventLoop, vllm: VllmEngine) -> None:
    request = PlanRequest(
        "stream", BUNDLED[3], "cf_vla", controls=Controls(n=2, thinking="always"), live=True
    )
    events = loop.run_until_complete(events_of(vllm, request))
    assert isinstance(events[0], Started)
    for index in range(2):
        sections = {
            event.section: event.text
            for event in events
            if isinstance(event, SectionFinished) and event.index == index
        }
        assert list(sections) == ["plan", "branch", "thinking", "revised_plan", "trajectory"]


def test_leaving_early_frees_vllm(loop: asyncio.AbstractEventLoop, vllm: VllmEngine) -> None:
    async def test() -> None:
        request = PlanRequest("early", BUNDLED[4], "cf_vla", controls=Controls(n=4, thinking="always"))
        async for _ in (events := vllm.submit(request)):
            break
        await events.aclose()
        assert vllm.llm.get_num_unfinished_requests() == 0
        waiting = asyncio.create_task(plan(vllm, request))
        while not vllm.llm.get_num_unfinished_requests():
            await asyncio.sleep(0.01)
        vllm.cancel("early")
        vllm.cancel("unknown")
        with pytest.raises(EngineError, match="cancelled"):
            await waiting
        assert vllm.llm.get_num_unfinished_requests() == 0
        assert len(await plan(vllm, request)) == 4

    loop.run_until_complete(test())


def test_bad_requests_fail_alone(loop: asyncio.AbstractEventLoop, vllm: VllmEngine) -> None:
    scene = BUNDLED[5]
    damaged = replace(scene, clips=(Clip(scene.clips[0].camera, (b"\xff\xd8no",) * 4), *scene.clips[1:]))

    async def test() -> None:
        good = asyncio.create_task(plan(vllm, PlanRequest("good", scene, "cf_vla", controls=Controls(n=2))))
        for bad, message in (
            (PlanRequest("a", damaged, "cf_vla"), "picture"),
            (PlanRequest("b", replace(scene, clips=scene.clips[:1]), "cf_vla"), "lacks camera"),
            (PlanRequest("c", scene, "elf_vla"), "unknown format"),
            (PlanRequest("d", scene, "cf_vla", controls=Controls(deadline_ms=50)), "torch engine"),
            (PlanRequest("e", scene, "cf_vla", controls=Controls(bind=True)), "bind needs the torch engine"),
            (PlanRequest("good", scene, "cf_vla"), "in use"),
        ):
            with pytest.raises((RequestError, ImageError), match=message):
                await plan(vllm, bad)
        assert len(await good) == 2

    loop.run_until_complete(test())


def test_the_trajectory_alone(
    loop: asyncio.AbstractEventLoop, vllm: VllmEngine, torch_engine: TorchEngine
) -> None:
    request = PlanRequest("direct", BUNDLED[6], "traj_only", Controls(n=1, temperature=0.0))
    [draw], [mine] = (loop.run_until_complete(plan(engine, request)) for engine in (vllm, torch_engine))
    assert draw.think_probability is None
    assert draw.codes == mine.codes
