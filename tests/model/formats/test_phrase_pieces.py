"""Reflections in phrases, and the plans that they lead to."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from looktwice.model.driving.direction import CHANGES, needed
from looktwice.model.driving.phrases import NOTHING, Facts, agrees, corrected, read_facts
from looktwice.model.driving.plan import TICKS, Plan, parse_plan
from looktwice.model.families.cf_vla.format import PHRASES
from looktwice.model.formats.cursor import CompiledFormat, Cursor, Token
from looktwice.model.formats.pieces import FormatError, Values
from looktwice.model.formats.text import parse
from tests.model.driving.strategies import facts
from tests.model.formats.strategies import VOCABULARY, plans
from tests.model.formats.test_grammar_export import allowed_by, in_plan, matcher
from tests.model.formats.test_laws import ids_of

COMPILED = CompiledFormat(PHRASES, VOCABULARY)
CODES = (0,) * 6
WAITS = parse_plan(
    "- longitudinal\n  - 0.0s-6.4s: Wait\n"
    "- lateral\n  - 0.0s-6.4s: Straight\n"
    "- lane\n  - 0.0s-6.4s: Keep Lane\n"
)


def think(cursor: Cursor, seed: int) -> list[Token]:
    """A response with a second look, written by uniform random choices."""
    random = np.random.default_rng(seed)
    written: list[Token] = []
    while True:
        forced, cursor = cursor.forced()
        written += forced
        if cursor.done:
            return written
        allowed = cursor.allowed()
        ids = allowed.ids
        if allowed.choice == "branch":
            ids = ids[["Thinking:" in cursor.option_texts(int(token)) for token in ids]]
        token = int(random.choice(ids))
        written.append(Token(token, cursor.section))
        cursor = cursor.advance(token)


def read(tokens: list[Token]) -> tuple[Plan, Facts, Plan]:
    values = parse(COMPILED, VOCABULARY.decode(ids_of(tokens)))
    plan, thinking, revised = values["plan"], values["thinking"], values["revised_plan"]
    assert isinstance(plan, Plan)
    assert isinstance(revised, Plan)
    return plan, read_facts(str(thinking)), revised


def response(plan: Plan, facts: Facts, revised: Plan) -> Values:
    return Values.of(
        {
            "plan": plan,
            "branch": "Thinking:",
            "thinking": str(facts),
            "revised_plan": revised,
            "trajectory": CODES,
        }
    )


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_revised_plan_changes_as_its_reflection_says(seed: int) -> None:
    tokens = think(COMPILED.start(), seed)
    plan, facts, revised = read(tokens)
    assert agrees(facts, plan, revised)
    assert corrected(plan, revised, facts) == revised  # other tracks are the same to the word
    assert len(tokens) <= COMPILED.longest()
    assert COMPILED.render(parse(COMPILED, VOCABULARY.decode(ids_of(tokens)))) == tokens


@settings(max_examples=30, deadline=None)
@given(plans(), st.integers(0, 2**32 - 1))
def test_so_it_does_behind_a_given_plan(plan: Plan, seed: int) -> None:
    tokens = think(COMPILED.start({"plan": plan}), seed)
    found, facts, revised = read(tokens)
    assert found == plan
    assert agrees(facts, plan, revised)


@settings(max_examples=30, deadline=None)
@given(plans(), plans(), facts())
def test_what_can_be_rendered_can_be_written(plan: Plan, better: Plan, facts: Facts) -> None:
    values = response(plan, facts, corrected(plan, better, facts))
    try:
        tokens = COMPILED.render(values)
    except FormatError:
        assert not agrees(facts, plan, corrected(plan, better, facts))
        return
    cursor = COMPILED.start()
    for token in tokens:
        assert token.id in cursor.allowed().ids
        cursor = cursor.advance(token.id)
    assert cursor.done
    assert parse(COMPILED, VOCABULARY.decode(ids_of(tokens))) == values


@settings(max_examples=30, deadline=None)
@given(plans(), facts())
def test_every_correction_that_is_offered_can_be_carried_out(plan: Plan, facts: Facts) -> None:
    room = all(needed(plan, change) <= TICKS for change in facts.changes)
    _, cursor = COMPILED.start({"plan": plan}).forced()
    text = f"Thinking:\n{facts}\n"
    possible = True
    for token in VOCABULARY.encode(text):
        try:
            cursor = cursor.advance(token)
        except FormatError:
            possible = False
            break
    # This vocabulary joins a period with the line break behind it, which are written apart.
    if possible or text.endswith(VOCABULARY.decode([token])):
        assert room
    else:
        assert not room


def test_who_waits_is_not_told_to_slow_down() -> None:
    assert needed(WAITS, "slower") > TICKS
    with pytest.raises(FormatError, match="leaves no room"):
        COMPILED.render(response(WAITS, slower(), WAITS))
    assert {change for change in CHANGES if needed(WAITS, change) <= TICKS} == {
        *("faster", "left", "right", "lane_left", "lane_right")
    }


def test_a_plan_that_changes_otherwise_is_refused() -> None:
    drives = parse_plan(str(WAITS).replace("Wait", "Keep Speed"))
    with pytest.raises(FormatError, match="is to stay as it is"):
        COMPILED.render(response(WAITS, read_facts(NOTHING), drives))
    with pytest.raises(FormatError, match="does too little slower"):
        COMPILED.render(response(drives, slower(), drives))
    given = {"plan": drives, "revised_plan": parse_plan(str(drives).replace("Keep Lane", "Left Lane Change"))}
    with pytest.raises(FormatError, match="changes otherwise"):
        COMPILED.render(response(drives, slower(), given["revised_plan"]), given)


def test_a_first_plan_may_lack_a_track() -> None:
    lacks = Plan(longitudinal=WAITS.longitudinal, lateral=WAITS.lateral)
    for seed in range(20):
        tokens = think(COMPILED.start({"plan": lacks}), seed)
        values = parse(COMPILED, VOCABULARY.decode(ids_of(tokens)), {"plan": lacks})
        revised = values["revised_plan"]
        assert isinstance(revised, Plan)
        assert revised.lane is not None
        assert agrees(read_facts(str(values["thinking"])), lacks, revised)


def test_what_stays_as_it_is_is_jumped_over() -> None:
    """Behind a good plan nothing but the codes is left to decide; behind a stated change one track is."""
    _, cursor = COMPILED.start({"plan": WAITS}).forced()
    for token in VOCABULARY.encode(f"Thinking:\n{NOTHING}"):
        cursor = cursor.advance(token)
    forced, cursor = cursor.forced()
    assert VOCABULARY.decode(ids_of(forced)) == (f"\nMeta Actions:\n{WAITS}Action:\n<|traj_future_start|>")
    assert len(cursor.allowed().ids) == len(VOCABULARY.code_ids(0))


def test_free_text_is_no_reflection() -> None:
    values = {**response(WAITS, Facts(), WAITS).by_section, "thinking": ("I should slow down.",)}
    with pytest.raises(FormatError, match="no reflection in phrases"):
        COMPILED.render(Values(values))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 400))
def test_its_grammar_allows_what_the_cursor_allows(seed: int, place: int) -> None:
    tokens = think(COMPILED.start(), seed)
    cursor = COMPILED.start()
    for token in tokens[: place % len(tokens)]:
        cursor = cursor.advance(token.id)
    state = matcher(cursor)
    assert allowed_by(state) == set(cursor.allowed().ids.tolist())
    for token in tokens[place % len(tokens) :]:
        mine, theirs = set(cursor.allowed().ids.tolist()), allowed_by(state)
        assert mine == theirs or (
            mine <= theirs and (in_plan(cursor) or cursor.section in ("thinking", "revised_plan"))
        )
        assert state.consume_token(token.id)
        cursor = cursor.advance(token.id)
    assert state.is_accepting()


def slower() -> Facts:
    return read_facts(
        "A barrier is in my lane some 20 metres ahead. "
        "Going on like this would bring me too close, so I should slow down sooner."
    )
