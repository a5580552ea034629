from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model.bundled import CHECKPOINT, SCENES
from model.driving.plan import parse_plan
from model.driving.scene_store import read_scenes
from model.engines.engine import (
    Controls,
    DraftFinished,
    Draw,
    DrawFinished,
    PlanRequest,
    RequestError,
    SectionFinished,
    Started,
    TextWritten,
)
from model.engines.torch.decoder import Counts, Decoder, Failed, Shortcuts
from model.engines.torch.pace import Pace
from model.engines.torch.runner import Runner
from model.formats.cf_vla import CF_VLA
from model.formats.cursor import CompiledFormat
from model.formats.pieces import BRANCH
from model.formats.text import parse
from model.network.checkpoint import Loaded, load
from tests.checkpoints import noisy_scene
from tests.model.engines.reference import exactly, reference_draws

PLAN = parse_plan(
    "- longitudinal\n  - 0.0s-2.0s: Decelerate\n  - 2.0s-6.4s: Wait\n"
    "- lateral\n  - 0.0s-6.4s: Straight\n- lane\n  - 0.0s-6.4s: Keep Lane\n"
)


@pytest.fixture(scope="module")
def exact(untrained_checkpoint: Path) -> Loaded:
    """In float64, so that rounding cannot flip a draw."""
    return exactly(load(untrained_checkpoint, dtype=torch.float64))


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
        decoder.check_integrity()
    return draws


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
    runner = Runner(exact, 13, clip_bytes=1 << 20, reuse=shortcuts.reuse)
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
        decoder = Decoder(Runner(exact, 6), replace(Shortcuts(), **off))
        decode(decoder, one)
        return decoder.counts

    everything = counts()
    assert counts(jump=False, speculate=False).passes > 2.5 * everything.passes
    assert everything.row_passes < everything.fan_out_row_passes
    unshared = counts(shared_rows=False)
    assert unshared.row_passes == unshared.fan_out_row_passes > everything.row_passes
    decision_by_decision = counts(speculate=False)
    assert decision_by_decision.kept == decision_by_decision.tokens
    assert everything.kept == decision_by_decision.kept < everything.tokens
    assert decision_by_decision.fan_out_row_passes == counts(speculate=False, shared_rows=False).row_passes


def test_cached_steps_equal_a_full_pass(exact: Loaded) -> None:
    """The decoder's greedy choice at every decision is that of one pass over the whole sequence."""
    one = request("a", 1, n=1, temperature=0.0, thinking="never")
    draw = decode(Decoder(Runner(exact, 1)), one)["a", 0]
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


class Clock:
    """Stands still unless it is moved."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_a_passed_deadline_leaves_thinking_out(exact: Loaded) -> None:
    draws = decode(Decoder(Runner(exact, 4)), request("a", n=2, thinking="always", deadline_ms=0))
    assert {(draw.branch, draw.cut) for draw in draws.values()} == {("Action:", "skipped")}


def test_in_time_a_reflection_replaces_its_draft(exact: Loaded) -> None:
    decoder = Decoder(Runner(exact, 4), clock=Clock())
    decoder.add(request("a", n=2, seed=4, thinking="always", deadline_ms=100_000))
    drafts, draws, order = {}, {}, []
    while not decoder.idle:
        for _, event in decoder.step():
            if isinstance(event, DraftFinished):
                drafts[event.draw.index] = event.draw
                order.append(("draft", event.draw.index))
            elif isinstance(event, DrawFinished):
                draws[event.draw.index] = event.draw
                order.append(("draw", event.draw.index))
        decoder.check_integrity()
    unhurried = decode(Decoder(Runner(exact, 4)), request("a", n=2, seed=4, thinking="always"))
    direct = decode(Decoder(Runner(exact, 4)), request("a", n=2, seed=4, thinking="never"))
    for index in range(2):
        assert order.index(("draft", index)) < order.index(("draw", index))
        assert draws[index].text == unhurried["a", index].text
        assert draws[index].cut is None
        assert drafts[index].text == direct["a", index].text


def test_at_the_deadline_the_draft_is_the_answer(exact: Loaded) -> None:
    clock = Clock()
    decoder = Decoder(Runner(exact, 4), clock=clock)
    decoder.add(request("a", n=2, seed=4, thinking="always", deadline_ms=100_000))
    drafts, draws = {}, {}
    while not decoder.idle:
        for _, event in decoder.step():
            if isinstance(event, DraftFinished):
                drafts[event.draw.index] = event.draw
            elif isinstance(event, DrawFinished):
                draws[event.draw.index] = event.draw
        decoder.check_integrity()
        if len(drafts) == 2:
            clock.now_s = 101.0
    assert [draws[index].text for index in range(2)] == [drafts[index].text for index in range(2)]
    assert {(draw.branch, draw.cut) for draw in draws.values()} == {("Action:", "replaced")}


@pytest.mark.parametrize("waits_for", ["room", "its prompt"])
def test_who_gave_way_is_answered_with_drafts_at_the_deadline(exact: Loaded, waits_for: str) -> None:
    clock = Clock()
    decoder = Decoder(Runner(exact, 4), clock=clock, prompt_chunk=8)
    decoder.add(request("a", n=2, seed=4, thinking="always", deadline_ms=9_000))
    drafts, draws = {}, {}

    def step() -> None:
        for name, event in decoder.step():
            if isinstance(event, DraftFinished):
                drafts[event.draw.index] = event.draw
            elif isinstance(event, DrawFinished):
                draws[name, event.draw.index] = event.draw
        decoder.check_integrity()

    while len(drafts) < 2:
        step()
    decoder.add(request("urgent", 1, "traj_only", n=2, deadline_ms=3_000))
    step()
    if waits_for == "its prompt":
        while ("urgent", 1) not in draws:
            step()
        step()
    assert ("a", 0) not in draws
    clock.now_s = 9.1
    step()
    assert (("urgent", 1) in draws) == (waits_for == "its prompt")
    assert [draws["a", index].text for index in range(2)] == [drafts[index].text for index in range(2)]
    assert {draws["a", index].cut for index in range(2)} == {"replaced"}
    while not decoder.idle:
        step()
    assert len(draws) == 4


def test_memory_for_drafts_is_kept_where_there_may_be_some(exact: Loaded) -> None:
    def reserved(format: str, **controls: object) -> int:
        decoder = Decoder(Runner(exact, 8), clock=Clock())
        decoder.add(request("a", 0, format, n=3, **controls))
        decoder.step()
        return decoder.rows_used

    assert reserved("cf_vla", deadline_ms=1000) == 6
    assert reserved("cf_vla", deadline_ms=1000, thinking="never") == 3
    assert reserved("traj_only", deadline_ms=1000) == 3


class Steady(Pace):
    """Steps of 10 ms, 40 of them behind a text, whatever is seen."""

    step_s, deviation_s, ending_passes, prompt_s = 0.01, 0.0, 40.0, 0.0

    def __init__(self) -> None:
        pass

    def saw_step(self, seconds: float) -> None:
        pass

    def saw_prompts(self, seconds: float, read: int) -> None:
        pass

    def saw_pass(self, seconds: float, rows: int) -> None:
        pass

    def saw_direct(self, passes: int) -> None:
        pass

    def direct_passes_left(self, passes: int) -> float:
        return max(1.0, 15.0 - passes)

    def pass_s(self, rows: int) -> float:
        return 0.01

    def saw_ending(self, passes: int) -> None:
        pass


def test_who_has_less_time_goes_first_and_the_others_lose_nothing(exact: Loaded) -> None:
    clock = Clock()
    decoder = Decoder(Runner(exact, 4), clock=clock)
    patient = request("patient", 0, n=4, seed=1, thinking="never")
    urgent = request("urgent", 1, "traj_only", n=2, seed=2, deadline_ms=1000)
    decoder.add(patient)
    for _ in range(12):
        decoder.step()
    decoder.add(urgent)
    draws = decode(decoder)
    assert [name for name, _ in draws] == ["urgent"] * 2 + ["patient"] * 4
    for asked in (patient, urgent):
        for draw in reference_draws(exact, asked):
            assert draws[asked.request_id, draw.index].text == draw.text


def test_thinking_is_cut_when_the_rest_would_not_fit(exact: Loaded) -> None:
    asked = request("a", n=1, seed=4, thinking="always", deadline_ms=100_000)
    unhurried = decode(Decoder(Runner(exact, 2), clock=Clock()), asked)["a", 0]
    clock = Clock()
    decoder = Decoder(Runner(exact, 2), clock=clock, pace=Steady())
    decoder.add(asked)
    draws = []
    while not decoder.idle:
        for _, event in decoder.step():
            if isinstance(event, SectionFinished) and event.section == "branch":
                clock.now_s = 99.7  # 30 steps are left
            draws += [event.draw] if isinstance(event, DrawFinished) else []
    (draw,) = draws
    assert draw.branch == "Thinking:"
    assert draw.revised_plan is not None
    assert draw.tokens["thinking"] < unhurried.tokens["thinking"]
    assert draw.plan == unhurried.plan


def test_thinking_ends_at_a_sentence_when_time_gets_short() -> None:
    trained = exactly(load(CHECKPOINT, dtype=torch.float64))
    [labelled, *_] = read_scenes(SCENES)
    controls = Controls(n=1, seed=1, thinking="always", deadline_ms=100_000)
    asked = PlanRequest("a", labelled.scene, "cf_vla", controls)
    unhurried = decode(Decoder(Runner(trained, 2), clock=Clock()), asked)["a", 0]
    clock = Clock()
    decoder = Decoder(Runner(trained, 2), clock=clock, pace=Steady())
    decoder.add(asked)
    draws = []
    while not decoder.idle:
        for _, event in decoder.step():
            if isinstance(event, SectionFinished) and event.section == "branch":
                clock.now_s = 99.5  # 50 steps are left and 40 are needed
            draws += [event.draw] if isinstance(event, DrawFinished) else []
    (draw,) = draws
    assert draw.cut == "shortened"
    assert draw.thinking is not None
    assert unhurried.thinking is not None
    first, *rest = re.split(r"(?<=[.!?]) ", unhurried.thinking)
    assert rest, "there is a sentence to leave out"
    assert draw.thinking == first
    assert draw.revised_plan is not None


def test_steps_that_vary_are_left_more_room() -> None:
    steady, varying = Pace(), Pace()
    for step in range(200):
        steady.saw_step(0.05)
        varying.saw_step(0.02 if step % 2 else 0.08)
    assert not steady.last_step(10.0, 9.94)
    assert steady.last_step(10.0, 9.96)
    assert varying.last_step(10.0, 9.9)
    assert not varying.last_step(10.0, 9.8)


def test_every_response_parses_at_high_temperature(untrained_checkpoint: Path) -> None:
    loaded = load(untrained_checkpoint)
    requests = [request(f"{k}", k, n=8, temperature=1.5, seed=k) for k in range(3)]
    draws = decode(Decoder(Runner(loaded, 24)), *requests)
    compiled = CompiledFormat(CF_VLA, loaded.vocabulary)
    assert len(draws) == 24
    for draw in draws.values():
        values = parse(CF_VLA, draw.text)
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
    finished: dict[int, str] = {}
    parts = 0
    while not decoder.idle:
        for _, event in decoder.step():
            if isinstance(event, TextWritten):
                assert event.section == "thinking"
                assert event.index not in finished
                told[event.index] += event.text
                parts += 1
            elif isinstance(event, SectionFinished) and event.section == "thinking":
                finished[event.index] = event.text
    assert parts > 4
    for index in range(2):
        assert finished[index].startswith(told[index])
        assert len(told[index]) > len(finished[index]) // 2


def test_a_request_starts_once_even_when_it_gives_way(exact: Loaded) -> None:
    clock = Clock()
    decoder = Decoder(Runner(exact, 2), clock=clock)
    decoder.add(request("patient", n=2))
    events = decoder.step()
    decoder.add(request("urgent", 1, n=1, thinking="never", deadline_ms=50))
    while not decoder.idle:
        events += decoder.step()
    assert [name for name, event in events if isinstance(event, Started)] == ["patient", "urgent"]


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
        ({"format": "traj_only", "prefill": PLAN}, "has no section 'plan'"),
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


def test_who_is_late_already_makes_nobody_else_late(exact: Loaded) -> None:
    clock = Clock()
    decoder = Decoder(Runner(exact, 2), clock=clock)
    decoder.add(request("late", 0, "traj_only", n=2, deadline_ms=1_000))
    decoder.add(request("in-time", 1, "traj_only", n=2, deadline_ms=3_000))
    decoder.add(request("whenever", 2, "traj_only", n=2))
    clock.now_s = 2.0
    draws = decode(decoder)
    assert [name for name, _ in draws] == ["in-time"] * 2 + ["late"] * 2 + ["whenever"] * 2


class Crowded(Steady):
    """As many rows as are fed make a pass so many times as long."""

    def pass_s(self, rows: int) -> float:
        return 0.01 * rows


@pytest.mark.parametrize(("deadline_ms", "together"), [(600, False), (3000, True)])
def test_others_wait_where_the_most_urgent_would_be_late_beside_them(
    exact: Loaded, deadline_ms: int, together: bool
) -> None:
    decoder = Decoder(Runner(exact, 8), clock=Clock(), pace=Crowded())
    decoder.add(request("patient", 0, "traj_only", n=2, temperature=0.0))
    decoder.add(request("urgent", 1, "traj_only", n=2, temperature=0.0, deadline_ms=deadline_ms))
    order, rows = [], []
    while not decoder.idle:
        before = decoder.counts.row_passes
        order += [name for name, event in decoder.step() if isinstance(event, DrawFinished)]
        rows.append(decoder.counts.row_passes - before)
        decoder.check_integrity()
    assert rows[0] == (2 if together else 1)
    assert sorted(order) == ["patient"] * 2 + ["urgent"] * 2
    if not together:
        assert order == ["urgent"] * 2 + ["patient"] * 2
