"""What engines tell of a draw's decisions is what training computes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from looktwice.model.engines.engine import Draw, PlanRequest
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.families.registry import families_of
from looktwice.model.formats.cursor import CompiledFormat, Cursor
from looktwice.model.formats.pieces import FormatError
from looktwice.model.formats.replay import decisions
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.training.batches import collate
from looktwice.model.training.learner import ResponseLearner
from looktwice.model.training.outcome.rollouts import rollout
from tests.model.engines.decoding import decode, request
from tests.model.engines.reference import exactly, reference

ASKED: list[dict[str, Any]] = [
    {"numbers": "drawn", "codes": "drawn", "temperature": 1.2},
    {"thinking": "always", "top_p": 0.7},
    {"thinking": "never", "temperature": 0.0, "bind": True},
]


@pytest.fixture(scope="module")
def loaded(untrained_checkpoint: Path) -> Loaded:
    return load(untrained_checkpoint)


@pytest.fixture(scope="module")
def exact(untrained_checkpoint: Path) -> Loaded:
    return exactly(load(untrained_checkpoint, torch.float64))


def drawn(loaded: Loaded, asked: PlanRequest) -> list[Draw]:
    with torch.inference_mode():
        draws = decode(Decoder(Runner(loaded, asked.controls.n)), asked)
    return [draws[asked.request_id, index] for index in range(asked.controls.n)]


def beginning(loaded: Loaded, format: str = "cf_vla") -> Cursor:
    family = families_of([format], loaded.settings.reflection)[format]
    return CompiledFormat(family.format, loaded.vocabulary).start()


@pytest.mark.parametrize("format", ["cf_vla", "traj_only"])
@pytest.mark.parametrize("controls", ASKED)
def test_the_learner_computes_what_the_engine_tells(
    loaded: Loaded, controls: dict[str, Any], format: str
) -> None:
    asks = {name: value for name, value in controls.items() if format == "cf_vla" or name != "thinking"}
    asked = [request(f"{scene}", scene, format, n=3, logprobs=True, **asks) for scene in range(2)]
    draws = [drawn(loaded, each) for each in asked]
    samples = [
        sample
        for each, some in zip(asked, draws, strict=True)
        for sample in rollout(each.scene, format, some, loaded.inputs)
    ]
    start = beginning(loaded, format)
    every = [draw for some in draws for draw in some]
    replayed = [decisions(start, draw.ids) for draw in every]
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec)
    found = learner.log_probabilities(collate(samples), replayed, asked[0].controls.temperature)
    for draw, made, logprobs in zip(every, replayed, found, strict=True):
        assert [position for position, told in enumerate(draw.logprobs) if told is not None] == [
            decision.position for decision in made
        ]
        told = [draw.logprobs[decision.position] for decision in made]
        np.testing.assert_allclose(logprobs.detach().numpy(), np.array(told, float), atol=1e-4)
    torch.autograd.backward(torch.cat(found).sum())
    assert loaded.model.lm_head.weight.grad is not None
    loaded.model.zero_grad()


@pytest.mark.parametrize("controls", [{"n": 4, "numbers": "drawn"}, {"n": 4, "thinking": "always"}])
def test_they_are_those_of_the_reference(exact: Loaded, controls: dict[str, Any]) -> None:
    asked = request("a", logprobs=True, **controls)
    families = families_of(exact.card.formats, exact.settings.reflection)
    start = beginning(exact)
    with torch.inference_mode():
        expected = reference(exact, asked, families)
    for draw, (_, shares) in zip(drawn(exact, asked), expected, strict=True):
        told = {place: value for place, value in enumerate(draw.logprobs) if value is not None}
        assert told.keys() == shares.keys()
        for decision in decisions(start, draw.ids):
            share = shares[decision.position][decision.place]
            assert told[decision.position] == pytest.approx(np.log(share), abs=1e-9)


def test_nothing_is_told_unless_asked_for(loaded: Loaded) -> None:
    [draw] = drawn(loaded, request("a", n=1))
    assert draw.logprobs == ()
    assert loaded.vocabulary.decode(draw.ids) == draw.text


def test_only_whole_responses_are_replayed(loaded: Loaded) -> None:
    [draw] = drawn(loaded, request("a", n=1))
    start = beginning(loaded)
    with pytest.raises(FormatError, match="goes on behind"):
        decisions(start, draw.ids[:-1])
    with pytest.raises(FormatError, match="not allowed"):
        decisions(start, draw.ids[1:])
    with pytest.raises(FormatError, match="complete"):
        decisions(start, (*draw.ids, draw.ids[-1]))


def test_long_draws_stand_behind_prompts_of_their_own(loaded: Loaded) -> None:
    asked = request("a", n=6, logprobs=True, temperature=1.2)
    draws = drawn(loaded, asked)
    rows = rollout(asked.scene, "cf_vla", draws, loaded.inputs)
    repeated = rollout(asked.scene, "cf_vla", 8 * draws, loaded.inputs)
    assert len(repeated) > len(rows)
    written = [response.ids for row in repeated for response in row.responses]
    assert written == 8 * [draw.ids for draw in draws]
    for row in repeated:
        assert row.prompt == rows[0].prompt
        lengths = [len(response.ids) for response in row.responses]
        assert len(row.prompt) + sum(lengths) <= max(1536, len(row.prompt) + lengths[0])
