"""Second looks in phrases, as the engine writes them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from looktwice.model.driving.agreement import reason_and_change
from looktwice.model.driving.phrases import corrected, read_facts
from looktwice.model.driving.plan import Plan, parse_plan
from looktwice.model.engines.torch.deadlines import LatencyModel
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.network.checkpoint import Loaded, load
from tests.model.engines.decoding import decode, request
from tests.model.engines.reference import exactly, reference_draws

WAITS = parse_plan(
    "- longitudinal\n  - 0.0s-6.4s: Wait\n"
    "- lateral\n  - 0.0s-6.4s: Straight\n"
    "- lane\n  - 0.0s-6.4s: Keep Lane\n"
)

pytestmark = pytest.mark.usefixtures("inference")


@pytest.fixture(scope="module")
def phrased(resampling_checkpoint: Path) -> Loaded:
    return exactly(load(resampling_checkpoint, dtype=torch.float64))


@pytest.mark.parametrize("prefill", [None, WAITS, Plan(longitudinal=WAITS.longitudinal)])
def test_every_second_look_agrees_with_its_change_of_plan(phrased: Loaded, prefill: Plan | None) -> None:
    """At a temperature at which nearly anything is written."""
    requests = [
        request(f"{k}", k, n=8, seed=k, thinking="always", temperature=2.0, prefill=prefill, reasons="any")
        for k in range(4)
    ]
    draws = decode(Decoder(Runner(phrased, 16)), *requests)
    assert len(draws) == 32
    stated = 0
    for draw in draws.values():
        assert draw.plan is not None
        assert draw.thinking is not None
        assert draw.revised_plan is not None
        assert reason_and_change(draw.thinking, draw.plan, draw.revised_plan) is True
        facts = read_facts(draw.thinking)
        stated += len(facts.statements)
        told = corrected(draw.plan, draw.revised_plan, facts)
        for group, track in draw.plan.tracks():
            assert told.track(group) == draw.revised_plan.track(group) or track is None
    assert stated > 16


def test_they_are_those_of_the_reference_decoder(phrased: Loaded) -> None:
    one = request("one", 1, n=2, seed=5, thinking="always", temperature=1.5)
    draws = decode(Decoder(Runner(phrased, 4)), one, request("other", 2, n=2, thinking="adaptive"))
    for expected in reference_draws(phrased, one):
        assert draws["one", expected.index].text == expected.text


def test_what_a_second_look_takes_is_learned_from_those_that_are_taken(phrased: Loaded) -> None:
    """Or a deadline that leaves time for one would leave it out for ever."""
    latency = LatencyModel()
    latency.ending_passes = 1000.0
    decoder = Decoder(Runner(phrased, 8), latency=latency)
    looks = [request(f"{k}", k, n=4, seed=k, thinking="always") for k in range(8)]
    assert {draw.branch for draw in decode(decoder, *looks).values()} == {"Thinking:"}
    learned = latency.ending_passes
    assert learned < 500
    decode(decoder, *(request(f"direct {k}", k, n=4, seed=k, thinking="never") for k in range(4)))
    assert latency.ending_passes == learned, "a direct answer tells nothing of it"
