from __future__ import annotations

from collections import Counter
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from looktwice.model.driving.plan import parse_plan
from looktwice.model.engines.engine import (
    Draw,
    RequestError,
    SectionFinished,
    TextWritten,
)
from looktwice.model.engines.torch.decoder import Counts, Decoder
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.engines.torch.shortcuts import Shortcuts
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.format import BRANCH
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.text import parse
from looktwice.model.network.checkpoint import Loaded, load
from tests.model.engines.decoding import Again, decode, request
from tests.model.engines.reference import reference_draws

PLAN = parse_plan(
    "- longitudinal\n  - 0.0s-2.0s: Decelerate\n  - 2.0s-6.4s: Wait\n"
    "- lateral\n  - 0.0s-6.4s: Straight\n- lane\n  - 0.0s-6.4s: Keep Lane\n"
)


pytestmark = pytest.mark.usefixtures("inference")

MIX = [
    request("a", 0, n=2, seed=1),
    request("b", 1, n=3, seed=2, thinking="never"),
    request("c", 2, "traj_only", n=2, seed=3, temperature=0.7, top_p=0.9),
    request("d", 3, n=1, temperature=0.0, prefill=PLAN),
    request("e", 4, n=3, seed=5, thinking="always", temperature=0.4),
    request("f", 5, n=2, seed=6, think_threshold=0.5),
]
SHORTCUTS = [field.name for field in fields(Shortcuts)]


@pytest.fixture(scope="module")
def plainly(exact: Loaded) -> dict[tuple[str, int], Draw]:
    """What the reference decoder writes for `MIX`."""
    with torch.inference_mode():
        return {(each.request_id, draw.index): draw for each in MIX for draw in reference_draws(exact, each)}


@pytest.mark.parametrize("off", [None, "all", *SHORTCUTS])
def test_draws_are_those_of_the_plain_decoder(
    exact: Loaded, plainly: dict[tuple[str, int], Draw], off: str | None
) -> None:
    shortcuts = Shortcuts.none() if off == "all" else replace(Shortcuts(), **({off: False} if off else {}))
    runner = Runner(
        exact, 13, clip_bytes=1 << 20, reuse=shortcuts.reuse, capture=Again if shortcuts.capture else None
    )
    draws = decode(Decoder(runner, shortcuts, prompt_chunk=50), *MIX)
    assert draws.keys() == plainly.keys()
    for key, draw in draws.items():
        assert draw.text == plainly[key].text, key
        assert draw.tokens == plainly[key].tokens
        assert (draw.think_probability is None) == (plainly[key].think_probability is None)
        assert draw.think_probability is None or draw.think_probability == pytest.approx(
            plainly[key].think_probability, rel=1e-9
        )
        assert np.array_equal(draw.trajectory, plainly[key].trajectory)


def test_shortcuts_save_what_they_are_for(exact: Loaded) -> None:
    """Of the counts only: speed is measured elsewhere."""
    one = request("a", 0, n=6, seed=1, temperature=0.3, thinking="always")

    def counts(**off: bool) -> Counts:
        # With room for all, so that nothing is fed twice.
        decoder = Decoder(Runner(exact, 6, usual_tokens=10_000), replace(Shortcuts(), **off))
        decode(decoder, one)
        return decoder.counts

    everything = counts()
    # The tokenizer has a token for most forced words, so there is less to jump over than with single digits.
    assert counts(jump=False, speculate=False).passes > 1.4 * everything.passes
    assert everything.row_passes < everything.fan_out_row_passes
    unshared = counts(shared_rows=False)
    assert unshared.row_passes == unshared.fan_out_row_passes > everything.row_passes
    decision_by_decision = counts(speculate=False)
    assert decision_by_decision.kept == decision_by_decision.tokens
    # A guess that is right up to a response's end was fed with the last code and the two markers behind it.
    fed_at_the_end = everything.kept - decision_by_decision.kept
    assert fed_at_the_end % 3 == 0
    assert 0 <= fed_at_the_end <= 3 * 6
    assert everything.kept < everything.tokens
    assert decision_by_decision.fan_out_row_passes == counts(speculate=False, shared_rows=False).row_passes


def test_cached_steps_equal_a_full_pass(exact: Loaded) -> None:
    """The decoder's greedy choice at every decision is that of one pass over the whole sequence."""
    one = request("a", 1, n=1, temperature=0.0, thinking="never", numbers="drawn", codes="drawn")
    draw = decode(Decoder(Runner(exact, 1)), one)["a", 0]
    inputs = exact.inputs.build(one.scene, "cf_vla")
    compiled = CompiledFormat(CF_VLA.format, exact.vocabulary)
    response = compiled.render(parse(compiled, draw.text))
    ids = torch.tensor([[*inputs.prompt.ids, *(token.id for token in response)]])
    logits = exact.model(
        input_ids=ids,
        pixel_values_videos=torch.from_numpy(inputs.patches),
        video_grid_thw=torch.from_numpy(inputs.video_grid_thw),
        history=torch.tensor(one.scene.history)[None],
        route=torch.tensor(one.scene.route)[None],
    ).logits[0]
    cursor = compiled.start()
    for place in range(len(inputs.prompt.ids), ids.shape[1]):
        allowed = cursor.allowed().ids
        token = int(ids[0, place])
        if cursor.allowed().choice != BRANCH:
            assert token == allowed[int(logits[place - 1, allowed].argmax())]
        cursor = cursor.advance(token)
    assert cursor.done


@pytest.mark.parametrize("thinking", ["always", "never"])
def test_the_caller_may_decide_the_branch(exact: Loaded, thinking: str) -> None:
    draws = decode(Decoder(Runner(exact, 2)), request("a", n=2, thinking=thinking))
    for draw in draws.values():
        assert draw.branch == ("Thinking:" if thinking == "always" else "Action:")
        assert (draw.revised_plan is not None) == (thinking == "always")
        assert draw.think_probability is not None
        assert 0 < draw.think_probability < 1


def test_the_threshold_decides_by_think_probability(exact: Loaded) -> None:
    decoder = Decoder(Runner(exact, 4))
    draws = decode(decoder, request("a", n=1), request("b", n=1, think_threshold=0.0))
    assert draws["b", 0].branch == "Thinking:"
    probability = draws["a", 0].think_probability
    assert probability is not None
    above = decode(decoder, request("c", n=1, think_threshold=min(1.0, probability + 1e-6)))
    assert above["c", 0].branch == "Action:"


def test_a_prefilled_plan_stands(exact: Loaded) -> None:
    draws = decode(Decoder(Runner(exact, 4)), request("a", n=3, prefill=PLAN))
    assert all(draw.plan == PLAN for draw in draws.values())


def test_every_response_parses_at_high_temperature(untrained_checkpoint: Path) -> None:
    loaded = load(untrained_checkpoint)
    requests = [request(f"{k}", k, n=8, temperature=1.5, seed=k) for k in range(3)]
    draws = decode(Decoder(Runner(loaded, 24)), *requests)
    compiled = CompiledFormat(CF_VLA.format, loaded.vocabulary)
    assert len(draws) == 24
    for draw in draws.values():
        values = parse(compiled, draw.text)
        assert values["plan"] == draw.plan
        if draw.branch == "Action:":
            assert draw.tokens == Counter(token.section for token in compiled.render(values))


def test_events_name_sections_in_order(exact: Loaded) -> None:
    decoder = Decoder(Runner(exact, 2))
    decoder.add(request("a", n=1, thinking="always"))
    sections = []
    while not decoder.idle:
        sections += [event.section for _, event in decoder.step() if isinstance(event, SectionFinished)]
    assert sections == ["plan", "branch", "thinking", "revised_plan", "trajectory"]


def test_text_is_told_as_it_is_written(exact: Loaded) -> None:
    decoder = Decoder(Runner(exact, 2))
    decoder.add(replace(request("a", n=2, seed=3, thinking="always", temperature=1.2), live=True))
    told = {0: "", 1: ""}
    finished: dict[int, Any] = {}
    parts = 0
    while not decoder.idle:
        for _, event in decoder.step():
            if isinstance(event, TextWritten):
                assert event.section == "thinking"
                assert event.index not in finished
                told[event.index] += event.text
                parts += 1
            elif isinstance(event, SectionFinished) and event.section == "thinking":
                [finished[event.index]] = event.values
    assert parts > 4
    for index in range(2):
        assert finished[index].startswith(told[index])
        assert len(told[index]) > len(finished[index]) // 2


def test_requests_beyond_the_rows_wait_and_are_served(exact: Loaded) -> None:
    decoder = Decoder(Runner(exact, 2))
    draws = decode(decoder, *(request(f"{k}", k, "traj_only", n=2) for k in range(3)))
    assert len(draws) == 6


def test_cancelling_frees_rows_and_spares_others(exact: Loaded) -> None:
    expected = decode(Decoder(Runner(exact, 4)), request("b", 1, "traj_only", n=2))
    decoder = Decoder(Runner(exact, 4))
    decoder.add(request("a", 0, n=2))
    decoder.add(request("b", 1, "traj_only", n=2))
    decoder.add(request("c", 2, n=2))
    decoder.step()
    decoder.cancel("a")
    decoder.cancel("c")
    draws = decode(decoder)
    assert {key: draw.text for key, draw in draws.items()} == {
        key: draw.text for key, draw in expected.items()
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "elf_vla"}, "unknown format"),
        ({"n": 9}, "at most 8 draws"),
        ({"format": "traj_only", "prefill": PLAN}, "'traj_only' have no plan to be given"),
    ],
)
def test_impossible_requests_are_refused(exact: Loaded, change: dict[str, object], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        Decoder(Runner(exact, 8)).add(request("a", **change))  # type: ignore[arg-type]


def test_habits_save_passes_and_change_nothing(exact: Loaded) -> None:
    def texts(decoder: Decoder, name: str) -> list[str]:
        draws = decode(decoder, request(name, n=3, seed=6, temperature=0.3, thinking="never"))
        return [draws[name, index].text for index in range(3)]

    decoder = Decoder(Runner(exact, 3))
    first = texts(decoder, "first")
    passes = decoder.counts.passes
    assert [texts(decoder, "second"), texts(decoder, "third")] == [first, first]
    assert decoder.counts.passes - passes < 2 * passes * 0.7
    assert texts(Decoder(Runner(exact, 3), replace(Shortcuts(), speculate=False)), "alone") == first
