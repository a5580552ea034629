"""What a prompt tells besides its sketch is copied behind a second look, whose words say why."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.direction import wanted_changes
from looktwice.model.driving.phrases import NOTHING, Bend, Clear, Statement, Thing, agrees, read_facts
from looktwice.model.driving.plan import Plan, parse_plan
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.families.cf_vla.targets import NANO_WEIGHTS
from looktwice.model.network.checkpoint import Loaded, load, with_second_sketches
from looktwice.model.network.intent import INTENT_TOKENS
from looktwice.model.training.batches import stacked
from looktwice.model.training.examples import Examples
from looktwice.model.training.intents import IntentDataset
from looktwice.model.training.own_plans import OwnPlans
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.sampler import Item
from looktwice.model.training.sketched_looks import SceneSecondSketch, same_words, second_look
from looktwice.model.training.vision_cache import open_vision
from tests.model.training.scenes import training_scene
from tests.model.training.second_sketches import standing_still

EXAMPLES = Examples.from_scenes((training_scene(index) for index in range(8)), (FRONT_WIDE, FRONT_TELE))
LEAD = Thing("vehicle", "my lane", 20, "slower")
BRAKE, STOP = (Statement(LEAD, "too close", how) for how in ("slower", "stop"))
STEER = Statement(Bend("left", 30), "out of lane", "left")
GO_ON = Statement(Clear(), "too cautious", "faster")


def plan(pace: str, way: str = "Straight") -> Plan:
    return parse_plan(f"- longitudinal\n  - 0.0s-6.4s: {pace}\n- lateral\n  - 0.0s-6.4s: {way}\n")


@pytest.fixture(scope="module")
def loaded(resampling_checkpoint: Path) -> Loaded:
    found = with_second_sketches(load(resampling_checkpoint))
    assert found.model.sketch_books is not None
    found.model.sketch_books.fill(found.codec)
    return found


@pytest.fixture(scope="module")
def own_plans(loaded: Loaded, tmp_path_factory: pytest.TempPathFactory) -> OwnPlans:
    vision = open_vision(loaded, EXAMPLES, tmp_path_factory.mktemp("vision"), mirrored=True)
    return OwnPlans(loaded.model, EXAMPLES, vision)


@pytest.mark.parametrize(
    ("second", "reasons", "said"),
    [
        (plan("Decelerate"), [BRAKE, STOP, GO_ON], [BRAKE]),
        (plan("Wait"), [BRAKE, STOP], [STOP]),
        (plan("Decelerate", "Left Turn"), [STEER, STOP, BRAKE], [BRAKE, STEER]),
        (plan("Decelerate", "Left Turn"), [STEER, GO_ON], [STEER]),
    ],
)
def test_the_words_say_why_and_lead_to_what_they_say(
    second: Plan, reasons: list[Statement], said: list[Statement]
) -> None:
    found = second_look(plan("Keep Speed"), second, reasons)
    assert found is not None
    facts = read_facts(found.thinking)
    assert facts.statements == tuple(said)
    assert found.revised_plan is not None
    assert agrees(facts, found.first_plan, found.revised_plan)
    assert not found.judged, "whether to look is not learned here"


@pytest.mark.parametrize(
    ("second", "reasons"),
    [(plan("Keep Speed"), [BRAKE, STEER]), (plan("Decelerate"), [GO_ON, STEER]), (plan("Wait"), [])],
)
def test_without_a_change_or_a_reason_nothing_is_said(second: Plan, reasons: list[Statement]) -> None:
    assert second_look(plan("Keep Speed"), second, reasons) is None


@pytest.mark.parametrize("route", [False, True])
@pytest.mark.parametrize("mirror", [False, True])
def test_what_is_copied_stands_in_the_prompt(
    loaded: Loaded, own_plans: OwnPlans, mirror: bool, route: bool
) -> None:
    model, data = loaded.model, IntentDataset(EXAMPLES, None, 1.0)
    seconds, books, reader = own_plans.seconds(tracks=True), model.sketch_books, model.track_reader
    assert seconds is not None
    assert books is not None
    assert reader is not None
    size, hidden = (
        books.widths.numel() * loaded.settings.codec_size,
        reader.tokens.out_features // INTENT_TOKENS,
    )
    codes = books.codes(torch.randn(size, hidden))
    batch = stacked([data.look(place, mirror=mirror, route=route) for place in range(len(EXAMPLES))])
    found = [seconds.find(place, mirror=mirror, route=route).vector for place in range(len(EXAMPLES))]
    vectors = torch.from_numpy(np.stack(found))
    with torch.inference_mode():
        motion = (batch[name] for name in ("tracks", "history", "route", "has_route"))
        prompt = reader(*motion, codes)
        copied = codes.tokens(vectors / codes.spread)
    stages = loaded.settings.sketch_tokens
    assert reader.second is not None
    told = prompt[:, -stages:] - reader.second.mark
    torch.testing.assert_close(told, copied, atol=1e-3, rtol=1e-3)
    assert (told - prompt[:, -2 * stages - 1 : -stages - 1]).abs().amax() > 0.01, "not twice the same"


def dataset(loaded: Loaded, own_plans: OwnPlans) -> ResponseDataset:
    parts = (EXAMPLES, loaded.codec, loaded.inputs, loaded.vocabulary, NANO_WEIGHTS)
    return ResponseDataset(*parts, pictures=True, own_plans=own_plans, sketched=True)


def items() -> list[Item]:
    """One of each example: with or without its route, by pictures or by tracks, mirrored or not."""
    return [
        Item(place, "cf_vla", bool(place % 3), tracks=bool(place % 2), mirror=place > 4)
        for place in range(len(EXAMPLES))
    ]


def test_second_looks_lead_to_the_second_sketch(
    loaded: Loaded, own_plans: OwnPlans, monkeypatch: pytest.MonkeyPatch
) -> None:
    choices = {
        tracks: standing_still(own_plans, EXAMPLES, loaded.codec, range(1, 8, 2), tracks=tracks)
        for tracks in (False, True)
    }
    monkeypatch.setattr(OwnPlans, "seconds", lambda _, *, tracks: choices[tracks])
    data, looks, others = dataset(loaded, own_plans), 0, 0
    for item in items() * 6:
        vector = choices[item.tracks].find(item.index, mirror=item.mirror, route=item.route).vector
        sample = data[item]
        first, second = (loaded.vocabulary.decode(each.ids) for each in sample.responses)
        assert "Thinking:" not in first
        if "Thinking:" not in second:
            others += 1
            continue
        looks += 1
        assert NOTHING not in second
        apart_m = np.linalg.norm(loaded.codec.books[0] - vector, axis=1) / 8  # of 64 poses
        np.testing.assert_allclose(sample.code_errors_m[1, 0], apart_m, atol=1e-3)
        assert (sample.code_shares[1, : loaded.settings.sketch_tokens].max(axis=1) == 1).all()
        begins, ends = (parse_plan(_told(second, part)) for part in (0, 1))
        assert wanted_changes(begins, ends)
    assert looks >= 5
    assert others >= 5


@pytest.mark.parametrize("gain", [0.0, 1.0])
def test_the_critic_says_which_sketches_deserve_a_look(
    loaded: Loaded, own_plans: OwnPlans, monkeypatch: pytest.MonkeyPatch, gain: float
) -> None:
    choices = {
        tracks: standing_still(own_plans, EXAMPLES, loaded.codec, range(1, 8, 2), tracks=tracks)
        for tracks in (False, True)
    }
    choices = {key: each._replace(gains=gain * each.gains) for key, each in choices.items()}
    monkeypatch.setattr(OwnPlans, "seconds", lambda _, *, tracks: choices[tracks])
    data, taught = dataset(loaded, own_plans), Counter[str]()
    for item in items() * 6:
        responses = data[item].responses
        texts = [loaded.vocabulary.decode(each.ids) for each in responses]
        if "Thinking:" not in texts[1]:
            continue
        for word, response in zip(("Action", "Thinking"), responses, strict=True):
            [weight] = [
                weight
                for id, weight in zip(response.ids, response.weights, strict=True)
                if loaded.vocabulary.decode([id]).startswith(word)
            ]
            taught[word] += weight > 0
    assert set(+taught) == {"Thinking" if gain else "Action"}


@pytest.mark.parametrize("same", [False, True])
def test_what_would_pay_and_no_words_tell_teaches_neither_branch(
    loaded: Loaded, own_plans: OwnPlans, monkeypatch: pytest.MonkeyPatch, same: bool
) -> None:
    """Where words differ, and nothing in view asks for the change, acting at once is taught."""
    for tracks in (False, True):
        seconds = own_plans.seconds(tracks=tracks)
        assert seconds is not None
        paying = seconds._replace(gains=np.ones_like(seconds.gains))
        monkeypatch.setattr(own_plans._readings[tracks], "seconds", paying)
    monkeypatch.setattr("looktwice.model.training.responses.reasoned_look", lambda *_: None)
    monkeypatch.setattr("looktwice.model.training.responses.same_words", lambda *_: same)
    data = dataset(loaded, own_plans)
    for item in items():
        first = data[item].responses[0]
        [weight] = [
            weight
            for id, weight in zip(first.ids, first.weights, strict=True)
            if loaded.vocabulary.decode([id]).startswith("Action")
        ]
        assert (weight > 0) == (not same)


def test_words_are_the_same_where_the_second_sketch_is_the_first(loaded: Loaded, own_plans: OwnPlans) -> None:
    place = 1
    sketch = own_plans.sketch(place, mirror=False, route=True, tracks=True)
    stands = standing_still(own_plans, EXAMPLES, loaded.codec, [place], tracks=True).vectors[0, 1, place]
    for vector, same in ((sketch, True), (stands, False)):
        second = SceneSecondSketch(vector, EXAMPLES.facts[place], 1.0)
        known = EXAMPLES.history[place], EXAMPLES.plan(place)
        assert same_words(loaded.codec, sketch, second, *known) == same


def _told(response: str, part: int) -> str:
    """The first or the revised plan of a response."""
    lines = response.split("Meta Actions:\n")[1 + part].splitlines()
    return "".join(f"{line}\n" for line in lines if line.startswith(("- ", "  - ")))
