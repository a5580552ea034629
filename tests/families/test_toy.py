"""A family that nothing but its folder knows plans over the engine, as the reference writes it."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncGenerator
from dataclasses import replace
from pathlib import Path
from typing import Any

import llguidance
import llguidance.hf
import llguidance.numpy
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client import CollectorRegistry

import looktwice.clients.wire as wire
from looktwice.clients.planner import PlannerClient, plan_request
from looktwice.model.driving.agreement import agreement
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.trajectory import present_speed
from looktwice.model.engines.engine import Controls, Draw, PlanRequest, SectionFinished, TextWritten
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.evaluation.open_loop import evaluate_draws
from looktwice.model.families.family import Lesson
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.grammar_export import to_lark
from looktwice.model.formats.text import parse
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.model.training.examples import Examples
from looktwice.model.training.response_targets import make_target
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.sampler import Item
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.operations.settings import Settings
from looktwice.service.planning.events import Judged, SceneEvent
from looktwice.service.planning.telling import PlanTeller
from looktwice.service.routes.streaming import wire_events
from tests.checkpoints import noisy_scene, write_untrained
from tests.families.toy import TOY, drive, turned, turns_of
from tests.model.driving.drives import MIDDLES_S, labelled_scene
from tests.model.engines.decoding import decode
from tests.model.engines.reference import exactly, reference_draws
from tests.model.evaluation.fakes import draw_of
from tests.model.training.scenes import training_scene
from tests.model.training.steps import two_losses
from tests.service.serving import serve

WEIGHTS = {"mood": 2.0, "why": 1.0, "gap": 1.0, "turns": 3.0, "speeds": 5.0}


@pytest.fixture(scope="module")
def checkpoint(toy_family: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the family, which an installed package declares."""
    folder = tmp_path_factory.mktemp("toy") / "checkpoint"
    return write_untrained(folder, narrow=True, settings=VlaSettings(name="toy", formats=("toy",)))


@pytest.fixture(scope="module")
def toy(checkpoint: Path) -> Loaded:
    return exactly(load(checkpoint, torch.float64))


def planned(toy: Loaded, **controls: Any) -> list[Draw]:
    """What the engine writes, which is what the reference writes."""
    asked = PlanRequest("a", noisy_scene(1), "toy", Controls(**controls))
    with torch.inference_mode():
        draws = decode(Decoder(Runner(toy, 2 * asked.controls.n), clock=lambda: 0.0), asked)
        expected = reference_draws(toy, asked)
    found = [draws["a", index] for index in range(asked.controls.n)]
    assert [(draw.text, draw.tokens) for draw in found] == [(draw.text, draw.tokens) for draw in expected]
    return found


def test_it_plans_in_its_own_words(toy: Loaded) -> None:
    draws = planned(toy, n=4, numbers="drawn", seed=3)
    for draw in draws:
        assert set(draw.tokens) - {"why"} == {"mood", "gap", "turns", "speeds"}
        speeds = [float(word) for word in draw.text.split(" at ")[-1].split(" m/s")[0].split(" ")]
        turns = tuple(map(int, re.findall(r"<\|toy_turn_(\d{4})\|>", draw.text)))
        [gap] = re.findall(r" keep <\|toy_gap_m_(\d{4})\|> m,", draw.text)
        np.testing.assert_array_equal(draw.trajectory, drive(tuple(speeds), turns))
        assert draw.sections == {"gap": [5.0 * int(gap)], "turns": [list(turns)]}
        assert (draw.plan, draw.codes, draw.times_s) == (None, (), (1.0, 2.0, 3.0, 4.0))


@pytest.mark.parametrize(("thinking", "word"), [("never", "Sure,"), ("always", "Hmm,")])
def test_controls_decide_at_its_branch(toy: Loaded, thinking: str, word: str) -> None:
    for draw in planned(toy, n=2, thinking=thinking):
        assert (draw.branch, draw.looked_twice) == (word, word == "Hmm,")
        assert draw.thinking is None or draw.thinking in draw.text
        assert draw.think_probability is not None


def test_a_deadline_makes_drafts_of_its_direct_option(toy: Loaded) -> None:
    asked = PlanRequest("a", noisy_scene(1), "toy", Controls(n=2, thinking="always", deadline_ms=0))
    late = iter(range(1_000_000))
    with torch.inference_mode():
        draws = decode(Decoder(Runner(toy, 4), clock=lambda: float(next(late))), asked)
    assert {draw.branch for draw in draws.values()} == {"Sure,"}
    assert {draw.cut for draw in draws.values()} <= {"skipped", "replaced"}


def test_it_plans_over_http_and_is_evaluated(checkpoint: Path) -> None:
    labelled = labelled_scene(12.0, pictures=1)
    engine = TorchEngine(checkpoint, TorchSettings(rows=4, products=None))
    with serve(engine, Settings()) as served, PlannerClient(served.url) as planner:
        # Nobody names the format: it is the checkpoint's first.
        result = planner.plan(labelled.scene, wire.Controls(n=2, logprobs=True))
        asked = plan_request(labelled.scene, wire.Controls(n=2, thinking="always"))
        events = list(planner.stream(asked))
    draws = []
    for planned in result.draws:
        assert planned.times_s == (1.0, 2.0, 3.0, 4.0)
        assert planned.trajectory.shape == (4, 4)
        assert planned.logprobs is not None
        assert len(planned.logprobs.token_ids) == sum(planned.tokens.values())
        assert list(planned.sections) == ["gap", "turns"]
        draws.append(replace(draw_of(planned.trajectory), times_s=planned.times_s))
    assert {name for name, _ in events} == {"branch", "thinking", "section", "trajectory", "done"}
    expert = labelled.future[[9, 19, 29, 39], :2]
    apart = np.linalg.norm([draw.trajectory[:, :2] - expert for draw in draws], axis=-1)
    measured = evaluate_draws(labelled, draws)
    assert measured.avg_ade_m == pytest.approx(apart.mean(), rel=1e-4)
    assert measured.min_fde_m == pytest.approx(apart[:, -1].min(), rel=1e-4)


def test_it_is_streamed_in_the_words_of_the_wire(toy: Loaded) -> None:
    [draw] = planned(toy, n=1, thinking="always")
    happened: list[SceneEvent] = [
        TextWritten(0, "why", "It"),
        SectionFinished(0, "why", " It rains.\n", ("It rains.",)),
        Judged(draw, agreement(None, "It rains.", None, draw.trajectory, noisy_scene(1).history)),
    ]

    async def told() -> list[Any]:
        async def events() -> AsyncGenerator[SceneEvent]:
            for event in happened:
                yield event

        first, metrics = SectionFinished(0, "mood", "Hmm,", ("Hmm,",)), Metrics(CollectorRegistry())
        return [event async for event in wire_events(first, events(), PlanTeller("toy"), metrics)]

    branch, it, rains, trajectory = asyncio.run(told())
    assert branch == ("branch", wire.BranchTaken(index=0, branch="Thinking:"))
    assert [it, rains] == [
        ("thinking", wire.ThinkingWritten(index=0, text=text)) for text in ("It", " rains.")
    ]
    assert trajectory[0] == "trajectory"


def test_training_reads_the_prompts_that_the_engine_reads(toy: Loaded) -> None:
    scenes = [training_scene(number) for number in range(4)]
    examples = Examples.from_scenes(scenes, toy.settings.cameras)
    data = ResponseDataset(examples, toy.codec, toy.inputs, toy.vocabulary, WEIGHTS, pictures=True)
    for number, labelled in enumerate(scenes):
        built = toy.inputs.build(labelled.scene, "toy")
        route = labelled.scene.route is not None
        assert data[Item(number, "toy", route)].prompt == built.prompt.ids.tolist()
        assert len(built.prompt.ids) <= toy.inputs.longest_prompt("toy")
        told = f"now at {present_speed(labelled.scene.history):.0f} m/s, goal {'' if route else 'unknown'}"
        assert told in toy.vocabulary.decode(built.prompt.ids)


def test_a_step_of_training_brings_it_nearer_to_the_expert(checkpoint: Path) -> None:
    toy = load(checkpoint)
    examples = Examples.from_scenes([training_scene(1)], toy.settings.cameras)
    data = ResponseDataset(examples, toy.codec, toy.inputs, toy.vocabulary, WEIGHTS, pictures=False)
    sample = data[Item(0, "toy", True)]
    before, after = two_losses(toy, sample)
    assert after < before


def test_a_labelled_scene_teaches_it(toy: Loaded) -> None:
    compiled = CompiledFormat(TOY.format, toy.vocabulary)
    labelled = labelled_scene(np.maximum(0, 12 - 4 * np.maximum(MIDDLES_S, 0)))
    future = labelled.future.copy()
    future[:, 3] = np.linspace(0, -1.3, 64)
    lesson = Lesson(expert_plan(labelled), (0,) * 6, future)
    target = make_target(TOY, compiled, lesson, WEIGHTS)
    text = toy.vocabulary.decode(target.ids)
    turns = "".join(f"<|toy_turn_{code:04d}|>" for code in (0, 0, 0, 0))
    assert text == f"Sure, keep <|toy_gap_m_0004|> m, turn {turns}, at 10 5 0 0 m/s<|im_end|>"
    assert parse(compiled, text)["speeds"] == (10.0, 5.0, 0.0, 0.0)
    assert set(target.weights) == {1.0, 2.0, 3.0, 5.0}


@given(st.lists(st.integers(0, 2), min_size=4, max_size=4).map(tuple))
def test_its_codec_gives_codes_back(turns: tuple[int, ...]) -> None:
    assert turns_of(turned(turns)) == turns


def test_its_grammar_allows_what_its_cursor_does(toy: Loaded) -> None:
    """The way to vLLM, which decodes under it."""
    tokenizer = llguidance.hf.from_tokenizer(toy.vocabulary.tokenizer)
    start = CompiledFormat(TOY.format, toy.vocabulary).start()
    grammar = llguidance.grammar_from("lark", to_lark(start))
    for draw in planned(toy, n=4, numbers="drawn", seed=5):
        matcher = llguidance.LLMatcher(tokenizer, grammar)
        cursor, bits = start, llguidance.numpy.allocate_token_bitmask(1, tokenizer.vocab_size)
        for token in draw.ids:
            llguidance.numpy.fill_next_token_bitmask(matcher, bits, 0)
            allowed = np.flatnonzero(np.unpackbits(bits.view(np.uint8), bitorder="little"))
            assert allowed.tolist() == cursor.allowed().ids.tolist()
            assert matcher.consume_token(token)
            cursor = cursor.advance(token)
        assert cursor.done
        assert matcher.is_accepting()
