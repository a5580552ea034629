"""Rows reserve what responses usually take, grow, and give way: nothing is lost by it and nothing changes."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from looktwice.model.engines.engine import Draw, DrawFinished, PlanRequest
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.request import Phase
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.network.checkpoint import Loaded
from tests.model.engines.decoding import Draws, decode, request
from tests.model.engines.integrity import check_integrity

pytestmark = pytest.mark.usefixtures("inference")

MIX = [
    request("long", 0, n=5, seed=1, thinking="always", temperature=1.5),
    request("due", 1, n=3, seed=2, thinking="always", deadline_ms=3_000),
    request("short", 2, "traj_only", n=2, seed=3),
]


def decoder(exact: Loaded, *, prompts: int | None, usual_tokens: int, reproducible: bool = False) -> Decoder:
    runner = Runner(exact, 16, prompts=prompts, usual_tokens=usual_tokens, reproducible=reproducible)
    return Decoder(runner, prompt_chunk=64, clock=lambda: 0.0)


@pytest.fixture(scope="module")
def undisturbed(exact: Loaded) -> Draws:
    """What is written where every response has room."""
    with torch.inference_mode():
        roomy = decoder(exact, prompts=None, usual_tokens=10_000)
        draws = decode(roomy, *MIX)
    assert roomy.counts.preempted == 0
    return draws


def same(found: Draws, expected: Draws) -> None:
    assert found.keys() == expected.keys()
    for key, draw in found.items():
        assert draw.text == expected[key].text, key
        assert draw.tokens == expected[key].tokens, key


@pytest.mark.parametrize("reproducible", [False, True])
@pytest.mark.parametrize("prompts", [2, 16])
def test_a_tree_that_outgrows_its_kv_row_goes_on_in_others(
    exact: Loaded, undisturbed: Draws, prompts: int, reproducible: bool
) -> None:
    """With few KV rows draws take turns, with many all go on."""
    tight = decoder(exact, prompts=prompts, usual_tokens=0, reproducible=reproducible)
    same(decode(tight, *MIX), undisturbed)
    assert tight.counts.preempted > 0


def test_requests_may_be_preempted_at_any_step(exact: Loaded, undisturbed: Draws) -> None:
    """In one of six steps some request loses all its memory, wherever it stands."""
    random = np.random.default_rng(0)
    disturbed = decoder(exact, prompts=4, usual_tokens=0)
    for each in MIX:
        disturbed.add(each)
    draws: dict[tuple[str, int], Draw] = {}
    preempted = 0
    while not disturbed.idle:
        running = [each for each in disturbed._scheduler.requests if each.phase is Phase.RUNNING]
        if running and random.random() < 1 / 6:
            disturbed._preempt(running[int(random.integers(len(running)))])
            check_integrity(disturbed)
            preempted += 1
        for name, event in disturbed.step():
            if isinstance(event, DrawFinished):
                assert (name, event.draw.index) not in draws, "a draw is answered twice"
                draws[name, event.draw.index] = event.draw
        check_integrity(disturbed)
    assert preempted > 3
    same(draws, undisturbed)


def test_a_request_that_waits_for_a_kv_row_can_be_cancelled(exact: Loaded) -> None:
    tight = decoder(exact, prompts=1, usual_tokens=0)
    tight.add(MIX[0])
    while tight.counts.preempted == 0:
        tight.step()
    tight.cancel("long")
    check_integrity(tight)
    assert tight.idle
    assert tight.rows_used == 0
    assert len(decode(tight, PlanRequest("next", MIX[2].scene, "traj_only"))) == 6


def test_kv_rows_have_room_for_usual_responses(exact: Loaded) -> None:
    """And for the longest one, but not for twelve of these."""
    runner = Runner(exact, 12)
    assert runner.kv_length >= runner.prompt_tokens + runner.row_tokens
    assert runner.kv_length < runner.prompt_tokens + 3 * runner.row_tokens


def test_scheduling_needs_no_torch() -> None:
    modules = ("batch", "deadlines", "drafter", "kv_memory", "layout", "request", "rows", "scheduler")
    script = "import sys; sys.modules['torch'] = None\n" + "".join(
        f"import looktwice.model.engines.torch.{module}\n" for module in modules
    )
    subprocess.run([sys.executable, "-c", script], check=True)
