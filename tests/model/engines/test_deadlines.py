"""A deadline: whose turn it is, what is cut to keep it, what is answered when it has come."""

from __future__ import annotations

import numpy as np
import pytest

from looktwice.model.driving.plan import plan_from_bins
from looktwice.model.engines.engine import (
    DraftFinished,
    Draw,
    DrawFinished,
    PlanRequest,
    SectionFinished,
    Started,
)
from looktwice.model.engines.torch.deadlines import LatencyModel, TimeFor
from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.formats.pieces import Value, Values
from looktwice.model.network.checkpoint import Loaded
from tests.model.engines.decoding import beginning, decode, request
from tests.model.engines.integrity import check_integrity
from tests.model.engines.reference import reference_draws

pytestmark = pytest.mark.usefixtures("inference")


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
        check_integrity(decoder)
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
        check_integrity(decoder)
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
        check_integrity(decoder)

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


class Steady(LatencyModel):
    """Steps of 10 ms, 40 of them behind a text, whatever is seen."""

    step_s, deviation_s, ending_passes = 0.01, 0.0, 40.0

    def __init__(self) -> None:
        pass

    def saw_step(self, seconds: float) -> None:
        pass

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


def at_the_branch(loaded: Loaded, asked: PlanRequest, now_s: float) -> Draw:
    """The only draw of a request, when the clock jumps to `now_s` as its branch is written."""
    clock = Clock()
    decoder = Decoder(Runner(loaded, 2), clock=clock, latency=Steady())
    decoder.add(asked)
    draws = []
    while not decoder.idle:
        for _, event in decoder.step():
            if isinstance(event, SectionFinished) and event.section == "branch":
                clock.now_s = now_s
            draws += [event.draw] if isinstance(event, DrawFinished) else []
    (draw,) = draws
    return draw


def test_thinking_is_cut_when_the_rest_would_not_fit(exact: Loaded) -> None:
    asked = request("a", n=1, seed=4, thinking="always", deadline_ms=100_000)
    unhurried = decode(Decoder(Runner(exact, 2), clock=Clock()), asked)["a", 0]
    draw = at_the_branch(exact, asked, 99.7)  # 30 steps are left
    assert draw.branch == "Thinking:"
    assert draw.revised_plan is not None
    assert draw.tokens["thinking"] < unhurried.tokens["thinking"]
    assert draw.plan == unhurried.plan


def test_thinking_ends_at_a_sentence_when_time_gets_short(exact: Loaded) -> None:
    row = beginning(exact, temperature=0.0)
    plan = plan_from_bins(np.zeros((3, 64), np.int8))
    values: dict[str, Value] = {
        "plan": plan,
        "branch": "Thinking:",
        "thinking": "A car stands ahead. I should slow down.",
        "revised_plan": plan,
        "trajectory": (0,) * 6,
    }
    ends = list[str]()
    for token in row.cursor.compiled.render(Values.of(values))[len(row.tokens) :]:
        if token.section == "thinking" and row.cursor.stop_id is not None:
            allowed = row.cursor.allowed().ids
            if row.cursor.stop_id in allowed:
                [(chosen, _)] = row.choices(np.zeros(len(allowed)), TimeFor.END_SENTENCE)
                if row.cut == "shortened":
                    assert chosen == row.cursor.stop_id
                    ends.append(exact.vocabulary.decode([each.id for each in row.tokens[-1:]]))
                    row.cut = None
        row.append(token.id, exact.vocabulary)
    assert [end[-1] for end in ends] == [".", "."]


def test_who_is_late_already_makes_nobody_else_late(exact: Loaded) -> None:
    clock = Clock()
    decoder = Decoder(Runner(exact, 2), clock=clock)
    decoder.add(request("late", 0, "traj_only", n=2, deadline_ms=1_000))
    decoder.add(request("in-time", 1, "traj_only", n=2, deadline_ms=3_000))
    decoder.add(request("whenever", 2, "traj_only", n=2))
    clock.now_s = 2.0
    draws = decode(decoder)
    assert [name for name, _ in draws] == ["in-time"] * 2 + ["late"] * 2 + ["whenever"] * 2


def test_a_request_starts_once_even_when_it_gives_way(exact: Loaded) -> None:
    clock = Clock()
    decoder = Decoder(Runner(exact, 2), clock=clock)
    decoder.add(request("patient", n=2))
    events = decoder.step()
    decoder.add(request("urgent", 1, n=1, thinking="never", deadline_ms=50))
    while not decoder.idle:
        events += decoder.step()
    assert [name for name, event in events if isinstance(event, Started)] == ["patient", "urgent"]


def test_steps_that_vary_are_left_more_room() -> None:
    steady, varying = LatencyModel(), LatencyModel()
    for step in range(200):
        steady.saw_step(0.05)
        varying.saw_step(0.02 if step % 2 else 0.08)
    assert not steady.last_step(10.0, 9.94)
    assert steady.last_step(10.0, 9.96)
    assert varying.last_step(10.0, 9.9)
    assert not varying.last_step(10.0, 9.8)


def test_a_picture_needs_the_time_that_pictures_took() -> None:
    latency = LatencyModel()
    latency.step_s = 0.01

    def may_begin(left_s: float) -> bool:
        return latency.time_for(left_s, 0.0, picture=True) is not TimeFor.END_NOW

    assert may_begin(1.0)
    assert not may_begin(0.5)
    for _ in range(100):
        latency.saw_picture(20)
    assert may_begin(0.25)
    assert not may_begin(0.15)
    assert latency.time_for(0.15, 0.0) is not TimeFor.END_NOW, "second looks have passes of their own"
