"""What goes wrong with one request is that request's alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from looktwice.model.engines.engine import Controls, Draw, PlanRequest, RequestError
from looktwice.model.engines.torch.deadlines import TimeFor
from looktwice.model.engines.torch.decoder import Decoder, Failed
from looktwice.model.engines.torch.drafter import Drafter
from looktwice.model.engines.torch.rows import Row
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.engines.torch.shortcuts import Shortcuts
from looktwice.model.network.checkpoint import Loaded
from tests.model.engines.decoding import decode_some, request
from tests.model.engines.integrity import check_integrity
from tests.model.engines.reference import reference_draws

BAD = "bad"


pytestmark = pytest.mark.usefixtures("inference")


def assert_as_alone(exact: Loaded, draws: dict[tuple[str, int], Draw], *requests: PlanRequest) -> None:
    for asked in requests:
        for draw in reference_draws(exact, asked):
            assert draws[asked.request_id, draw.index].text == draw.text


def test_a_scene_without_numbers_fails_alone_and_nobody_reads_what_it_wrote(
    exact: Loaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad, good, later = (
        request(BAD, 7, n=2, seed=7),
        request("good", 2, n=2, seed=2),
        request("later", 4, n=2, seed=4),
    )
    embed = exact.model.embed_prompt

    def embedding(prompt: Any, vision_tokens: Any, history: Any, *others: Any) -> Any:
        embedded = embed(prompt, vision_tokens, history, *others)
        if history is bad.scene.history:
            embedded.embeddings[-3:] = float("nan")
        return embedded

    monkeypatch.setattr(exact.model, "embed_prompt", embedding)
    decoder = Decoder(Runner(exact, 8))
    decoder.add(good)
    decoder.add(bad)
    failed: list[Failed] = []
    while not failed:
        failed = [event for _, event in decoder.step() if isinstance(event, Failed)]
    assert "no numbers" in str(failed[0].error)
    # Its prompt is one shorter, it is where the failed one was, and it is read as far as the other has come.
    draws, others = decode_some(decoder, later)
    assert not others
    assert_as_alone(exact, draws, good, later)


def test_a_scene_that_cannot_be_embedded_fails_alone(exact: Loaded, monkeypatch: pytest.MonkeyPatch) -> None:
    bad, good = request(BAD, 7, n=2, seed=7), request("good", 2, n=2, seed=2)
    embed = exact.model.embed_prompt

    def embedding(prompt: Any, vision_tokens: Any, history: Any, *others: Any) -> Any:
        if history is bad.scene.history:
            raise ArithmeticError("no")
        return embed(prompt, vision_tokens, history, *others)

    monkeypatch.setattr(exact.model, "embed_prompt", embedding)
    draws, failed = decode_some(Decoder(Runner(exact, 8)), bad, good)
    assert list(failed) == [BAD]
    assert_as_alone(exact, draws, good)


@pytest.mark.parametrize("decision", [0, 3])
def test_a_draw_that_cannot_go_on_ends_its_request_alone(
    exact: Loaded, monkeypatch: pytest.MonkeyPatch, decision: int
) -> None:
    choices, seen = Row.choices, []

    def choosing(row: Row, logits: npt.NDArray[np.float64], time_for: TimeFor) -> Any:
        if row.request.id == BAD:
            seen.append(row)
            if len(seen) > decision:
                raise ArithmeticError("no")
        return choices(row, logits, time_for)

    monkeypatch.setattr(Row, "choices", choosing)
    good = request("good", 2, n=2, seed=2)
    draws, failed = decode_some(Decoder(Runner(exact, 8)), request(BAD, 7, n=4, seed=7), good)
    assert list(failed) == [BAD]
    assert "a draw could not go on: no" in str(failed[BAD])
    assert_as_alone(exact, draws, good)


@pytest.mark.parametrize(
    ("method", "message", "shared"),
    [
        ("propose", "could not go on", True),
        ("propose", "could not go on", False),
        ("finished", "be read", True),
    ],
)
def test_a_guess_that_goes_wrong_ends_its_request_alone(
    exact: Loaded, monkeypatch: pytest.MonkeyPatch, method: str, message: str, shared: bool
) -> None:
    guess = getattr(Drafter, method)

    def guessing(drafter: Drafter, row: Row, *rest: Any) -> Any:
        if row.request.id == BAD and len(row.tokens) > 20:
            raise ArithmeticError("no")
        return guess(drafter, row, *rest)

    monkeypatch.setattr(Drafter, method, guessing)
    good = request("good", 2, n=2, seed=2)
    decoder = Decoder(Runner(exact, 8), Shortcuts(shared_prompts=shared))
    draws, failed = decode_some(decoder, request(BAD, 7, n=4, seed=7), good)
    assert list(failed) == [BAD]
    assert message in str(failed[BAD])
    assert_as_alone(exact, draws, good)


def test_rows_that_nobody_owns_are_found(exact: Loaded) -> None:
    decoder = Decoder(Runner(exact, 8))
    decoder.add(request("running", n=2))
    for _ in range(3):
        decoder.step()
    check_integrity(decoder)
    running = decoder._scheduler.get("running")
    assert running is not None
    decoder._scheduler.remove(running)
    with pytest.raises(AssertionError, match="held for nobody"):
        check_integrity(decoder)
    running.end(decoder._memory)


@pytest.mark.parametrize(
    ("controls", "message"),
    [
        ({"n": 0}, "n must be"),
        ({"n": 1_000_000}, "n must be"),
        ({"n": 2.5}, "n must be"),
        ({"think_threshold": -0.01}, "think_threshold must lie"),
        ({"think_threshold": 1.01}, "think_threshold must lie"),
        ({"think_threshold": float("nan")}, "think_threshold must lie"),
        ({"think_threshold": 0.5, "thinking": "always"}, "only has a meaning"),
        ({"thinking": "sometimes"}, "thinking must be"),
        ({"temperature": -0.1}, "temperature must lie"),
        ({"temperature": float("nan")}, "temperature must lie"),
        ({"top_p": 0.0}, "top_p must lie"),
        ({"seed": 0.5}, "seed must be"),
        ({"deadline_ms": -1}, "deadline_ms must be"),
        ({"deadline_ms": float("nan")}, "deadline_ms must be"),
    ],
)
def test_controls_that_mean_nothing_are_refused(controls: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        Controls(**controls)
