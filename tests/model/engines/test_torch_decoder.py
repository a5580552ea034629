from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from model.driving.plan import parse_plan
from model.engines.engine import Controls, Draw, DrawFinished, PlanRequest, RequestError, SectionFinished
from model.engines.torch.decoder import Decoder, Failed
from model.engines.torch.runner import Runner
from model.formats.cf_vla import CF_VLA
from model.formats.cursor import CompiledFormat
from model.formats.pieces import BRANCH
from model.formats.text import parse
from model.network.checkpoint import Loaded, load
from tests.checkpoints import noisy_scene

PLAN = parse_plan(
    "- longitudinal\n  - 0.0s-2.0s: Decelerate\n  - 2.0s-6.4s: Wait\n"
    "- lateral\n  - 0.0s-6.4s: Straight\n- lane\n  - 0.0s-6.4s: Keep Lane\n"
)


@pytest.fixture(scope="module")
def exact(untrained_checkpoint: Path) -> Loaded:
    """In float64, so that rounding cannot flip a draw."""
    return load(untrained_checkpoint, dtype=torch.float64)


@pytest.fixture(autouse=True)
def _inference() -> Iterator[None]:
    with torch.inference_mode():
        yield


def request(name: str, scene: int = 0, format: str = "cf_vla", **controls: object) -> PlanRequest:
    return PlanRequest(name, noisy_scene(scene, route=scene % 2 == 1), format, Controls(**controls))  # type: ignore[arg-type]


def decode(decoder: Decoder, *requests: PlanRequest) -> dict[tuple[str, int], Draw]:
    for each in requests:
        decoder.add(each)
    draws = {}
    while not decoder.idle:
        for name, event in decoder.step():
            assert not isinstance(event, Failed), event
            if isinstance(event, DrawFinished):
                draws[name, event.draw.index] = event.draw
    return draws


def test_a_draw_is_the_same_alone_in_a_batch_and_token_by_token(exact: Loaded) -> None:
    requests = [
        request("a", 0, n=2, seed=1),
        request("b", 1, n=3, seed=2, thinking="never"),
        request("c", 2, "traj_only", n=2, seed=3, temperature=0.7, top_p=0.9),
        request("d", 3, n=1, temperature=0.0, prefill=PLAN),
    ]
    together = decode(Decoder(Runner(exact, rows=8, length=1536)), *requests)
    assert len(together) == 8
    for jump in (True, False):
        for each in requests:
            alone = decode(Decoder(Runner(exact, rows=3, length=1536), jump=jump), each)
            for key, draw in alone.items():
                assert draw.text == together[key].text
                assert draw.tokens == together[key].tokens
                assert np.array_equal(draw.trajectory, together[key].trajectory)


def test_cached_steps_equal_a_full_pass(exact: Loaded) -> None:
    """The decoder's greedy choice at every decision is that of one pass over the whole sequence."""
    one = request("a", 1, n=1, temperature=0.0, thinking="never")
    draw = decode(Decoder(Runner(exact, rows=1, length=1536)), one)["a", 0]
    inputs = exact.inputs.build(one.scene, "cf_vla")
    compiled = CompiledFormat(CF_VLA, exact.vocabulary)
    response = compiled.render(parse(CF_VLA, draw.text))
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
    draws = decode(Decoder(Runner(exact, rows=2, length=1536)), request("a", n=2, thinking=thinking))
    for draw in draws.values():
        assert draw.branch == ("Thinking:" if thinking == "always" else "Action:")
        assert (draw.revised_plan is not None) == (thinking == "always")
        assert draw.think_probability is not None
        assert 0 < draw.think_probability < 1


def test_the_threshold_decides_by_think_probability(exact: Loaded) -> None:
    decoder = Decoder(Runner(exact, rows=4, length=1536))
    draws = decode(decoder, request("a", n=1), request("b", n=1, think_threshold=0.0))
    assert draws["b", 0].branch == "Thinking:"
    probability = draws["a", 0].think_probability
    assert probability is not None
    above = decode(decoder, request("c", n=1, think_threshold=min(1.0, probability + 1e-6)))
    assert above["c", 0].branch == "Action:"


def test_a_prefilled_plan_stands(exact: Loaded) -> None:
    draws = decode(Decoder(Runner(exact, rows=4, length=1536)), request("a", n=3, prefill=PLAN))
    assert all(draw.plan == PLAN for draw in draws.values())


def test_a_passed_deadline_leaves_thinking_out(exact: Loaded) -> None:
    draws = decode(
        Decoder(Runner(exact, rows=2, length=1536)), request("a", n=2, thinking="always", deadline_ms=0)
    )
    assert all(draw.branch == "Action:" for draw in draws.values())


def test_every_response_parses_at_high_temperature(untrained_checkpoint: Path) -> None:
    loaded = load(untrained_checkpoint)
    requests = [request(f"{k}", k, n=8, temperature=1.5, seed=k) for k in range(3)]
    draws = decode(Decoder(Runner(loaded, rows=24, length=1536)), *requests)
    compiled = CompiledFormat(CF_VLA, loaded.vocabulary)
    assert len(draws) == 24
    for draw in draws.values():
        values = parse(CF_VLA, draw.text)
        assert values["plan"] == draw.plan
        if draw.branch == "Action:":
            assert draw.tokens == Counter(token.section for token in compiled.render(values))


def test_events_name_sections_in_order(exact: Loaded) -> None:
    decoder = Decoder(Runner(exact, rows=2, length=1536))
    decoder.add(request("a", n=1, thinking="always"))
    sections = []
    while not decoder.idle:
        sections += [event.section for _, event in decoder.step() if isinstance(event, SectionFinished)]
    assert sections == ["plan", "branch", "thinking", "revised_plan", "trajectory"]


def test_requests_beyond_the_rows_wait_and_are_served(exact: Loaded) -> None:
    decoder = Decoder(Runner(exact, rows=2, length=1536))
    draws = decode(decoder, *(request(f"{k}", k, "traj_only", n=2) for k in range(3)))
    assert len(draws) == 6


def test_cancelling_frees_rows_and_spares_others(exact: Loaded) -> None:
    expected = decode(Decoder(Runner(exact, rows=4, length=1536)), request("b", 1, "traj_only", n=2))
    decoder = Decoder(Runner(exact, rows=4, length=1536))
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
        ({"format": "traj_only", "prefill": PLAN}, "has no section 'plan'"),
    ],
)
def test_impossible_requests_are_refused(exact: Loaded, change: dict[str, object], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        Decoder(Runner(exact, rows=8, length=1536)).add(request("a", **change))  # type: ignore[arg-type]
