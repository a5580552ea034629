from __future__ import annotations

from itertools import cycle, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.plan import GROUPS, TICKS, WORDS, Plan, format_tick, parse_plan
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.families.cf_vla.format import MAX_THINKING_TOKENS
from looktwice.model.families.cf_vla.traj_only import TRAJ_ONLY
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.fixed import FixedValues
from looktwice.model.formats.pieces import (
    Choice,
    Format,
    FormatError,
    Literal,
    Option,
    Record,
    Section,
    Sequence,
    Value,
    Values,
)
from looktwice.model.formats.plan_tracks import MAX_SEGMENTS
from looktwice.model.formats.text import parse
from tests.model.formats.strategies import VOCABULARY, branching_formats, cf_vla_values, plans
from tests.model.formats.test_laws import assert_writable, walk

COMPILED = CompiledFormat(CF_VLA.format, VOCABULARY)
FORMATS = {family.name: family.format for family in (CF_VLA, TRAJ_ONLY)}
FULL = parse_plan("".join(f"- {group}\n  - 0.0s-6.4s: {WORDS[group][0]}\n" for group in GROUPS))
PLAN = parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n- lateral\n  - 0.0s-6.4s: Straight\n")


@given(cf_vla_values())
def test_rendered_values_parse_to_themselves(values: Values) -> None:
    tokens = COMPILED.render(values)
    assert parse(COMPILED, VOCABULARY.decode([token.id for token in tokens])) == values


@given(cf_vla_values())
def test_rendered_tokens_can_be_written_one_by_one(values: Values) -> None:
    assert_writable(COMPILED, COMPILED.render(values))


@given(st.sampled_from(sorted(FORMATS)), st.integers(0, 2**32 - 1))
def test_whatever_is_written_parses_and_renders_back(name: str, seed: int) -> None:
    compiled = CompiledFormat(FORMATS[name], VOCABULARY)
    tokens = walk(compiled.start(), seed)
    values = parse(compiled, VOCABULARY.decode([token.id for token in tokens]))
    # Free text may be split otherwise by the tokenizer; everything else is the same to the token.
    rendered = compiled.render(values)
    keep = [token for token in tokens if token.section != "thinking"]
    assert [token for token in rendered if token.section != "thinking"] == keep


@given(branching_formats(), st.integers(0, 2**32 - 1))
def test_whatever_is_written_in_a_made_up_format_parses(format: Format, seed: int) -> None:
    compiled = CompiledFormat(format, VOCABULARY)
    tokens = walk(compiled.start(), seed)
    assert len(tokens) <= compiled.longest()
    values = parse(compiled, VOCABULARY.decode([token.id for token in tokens]))
    assert {token.section for token in tokens} >= set(values) >= {"plan", "branch", "trajectory"}


@given(plans(), st.integers(0, 1000))
def test_a_given_plan_is_forced_and_tokenised_as_the_model_writes_it(plan: Plan, seed: int) -> None:
    forced, _ = COMPILED.start({"plan": plan}).forced()
    values = Values.of({"plan": plan, "branch": "Action:", "trajectory": (0,) * 6})
    assert forced == [token for token in COMPILED.render(values) if token.section == "plan"]
    written = walk(COMPILED.start({"plan": plan}), seed)
    assert parse(COMPILED, VOCABULARY.decode([token.id for token in written]), {"plan": plan})["plan"] == plan


@given(st.integers(0, 2**32 - 1))
def test_no_word_follows_itself(seed: int) -> None:
    written = [token.id for token in walk(COMPILED.start(), seed)]
    plan = parse(COMPILED, VOCABULARY.decode(written))["plan"]
    assert isinstance(plan, Plan)
    assert all(one.word != two.word for _, track in plan.tracks() for one, two in pairwise(track))


def test_equal_neighbours_of_a_given_plan_are_joined() -> None:
    split = parse_plan(
        str(PLAN).replace("  - 0.0s-6.4s: Wait\n", "  - 0.0s-2.0s: Wait\n  - 2.0s-6.4s: Wait\n")
    )
    assert split != PLAN
    assert COMPILED.start({"plan": split}).forced()[0] == COMPILED.start({"plan": PLAN}).forced()[0]


def test_a_given_plan_may_lack_a_group() -> None:
    written = walk(COMPILED.start({"plan": PLAN}), 0)
    text = VOCABULARY.decode([token.id for token in written])
    assert parse(COMPILED, text, {"plan": PLAN})["plan"] == PLAN
    with pytest.raises(FormatError, match="expected '- lane"):
        parse(COMPILED, text)


def test_end_times_lie_behind_the_start() -> None:
    cursor = COMPILED.start()
    _, cursor = cursor.forced()
    for character in "6.3":
        cursor = cursor.advance(VOCABULARY.encode(character)[0])
    _, cursor = cursor.forced()  # s:
    assert cursor.option_texts(int(cursor.allowed().ids[-1]))[0].startswith(" ")
    cursor = cursor.advance(VOCABULARY.encode(" Keep")[0])
    forced, _ = cursor.forced()
    text = VOCABULARY.decode([token.id for token in forced])
    assert text.startswith(" Speed\n  - 6.3s-6.4s:")  # only one end time is left


def test_the_last_segment_reaches_the_horizon() -> None:
    written = [token.id for token in walk(COMPILED.start(), 7)]
    plan = parse(COMPILED, VOCABULARY.decode(written))["plan"]
    assert isinstance(plan, Plan)
    assert all(len(track) <= 12 for _, track in plan.tracks())


def test_free_text_stops_at_its_budget() -> None:
    _, cursor = COMPILED.start({"plan": PLAN}).forced()
    cursor = cursor.advance(VOCABULARY.encode("Thinking:")[0])
    _, cursor = cursor.forced()
    letter = VOCABULARY.encode("a")[0]
    newline = VOCABULARY.encode("\n")[0]
    assert newline not in cursor.allowed().ids  # thinking is never empty
    for _ in range(MAX_THINKING_TOKENS):
        assert cursor.section == "thinking"
        cursor = cursor.advance(letter)
    assert list(cursor.allowed().ids) == [newline]


def test_the_branch_names_its_options() -> None:
    _, cursor = COMPILED.start({"plan": PLAN}).forced()
    allowed = cursor.allowed()
    assert allowed.choice == "branch"
    texts = {cursor.option_texts(int(token)) for token in allowed.ids}
    assert texts == {("Action:",), ("Thinking:",)}


def test_tokens_out_of_turn_are_refused() -> None:
    cursor = COMPILED.start()
    with pytest.raises(FormatError, match="not allowed in section 'plan'"):
        cursor.advance(VOCABULARY.encode("x")[0])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"plan": FULL}, "section 'branch' needs a value"),
        ({"plan": PLAN}, "a plan with the groups longitudinal, lateral, lane is needed"),
        ({"plan": FULL, "branch": "Action"}, "none of"),
        ({"plan": FULL, "branch": "Action:", "trajectory": (1, 2)}, "cannot be written"),
        ({"plan": FULL, "branch": "Action:", "trajectory": (16,) * 6}, "code 16 is none of 0 to 15"),
        ({"plan": FULL, "branch": "Action:", "trajectory": (0,) * 6, "thinking": "a"}, "more values than"),
        ({"plan": FULL, "branch": "Thinking:", "thinking": "a\nb"}, "must be text without"),
        ({"plan": FULL, "branch": "Thinking:", "thinking": "caf\xe9"}, "no allowed token"),
        ({"plan": FULL, "branch": "Thinking:", "thinking": "a" * 500}, "at most 160"),
        ({"speech": "a"}, "needs a value"),
    ],
)
def test_values_that_cannot_be_written_are_refused(values: dict[str, Value], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        COMPILED.render(Values.of(values))


def test_given_sections_must_exist() -> None:
    with pytest.raises(FormatError, match="has no section"):
        CompiledFormat(TRAJ_ONLY.format, VOCABULARY).start({"plan": PLAN})


@given(cf_vla_values(), st.sampled_from(["Action:", "Thinking:"]))
def test_choices_can_be_made_beforehand(values: Values, picked: str) -> None:
    cursor = COMPILED.start(picks={"branch": picked})
    for token in COMPILED.render(values):
        if token.section == "branch" and values["branch"] != picked:
            # What is picked is forced; anything else cannot be written.
            assert len(cursor.allowed().ids) == 1
            assert token.id not in cursor.allowed().ids
            return
        cursor = cursor.advance(token.id)
    assert cursor.done


def test_choices_of_a_record_can_be_made_beforehand() -> None:
    mood = Record(Choice((Option("glad"), Option("wary")), "mood"))
    format = Format("made up", Sequence((Section("mood", mood), Literal("<|im_end|>"))))
    forced, cursor = CompiledFormat(format, VOCABULARY).start(picks={"mood": "wary"}).forced()
    assert cursor.done
    assert VOCABULARY.decode([token.id for token in forced]) == "wary<|im_end|>"


@pytest.mark.parametrize(
    ("picks", "message"),
    [({"mood": "Sure,"}, "no choice 'mood'"), ({"branch": "Sure,"}, "'branch' has no option 'Sure,'")],
)
def test_only_options_that_there_are_can_be_picked(picks: dict[str, str], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        COMPILED.start(picks=picks)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"mood": ("glad",)}, "section 'mood' has more values than the format writes: 'glad'"),
        ({"trajectory": ((0,) * 6,)}, "section 'trajectory' stands in 2 places"),
        ({"branch": ("Sure,",)}, "'Sure,' is none of Action:, Thinking:"),
        ({"thinking": ("Too fast.",)}, "what a FreeText says cannot be decided"),
        ({"plan": ("Keep Lane",)}, "a plan is needed, not 'Keep Lane'"),
    ],
)
def test_only_what_a_section_can_say_is_decided(said: FixedValues, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        COMPILED.start(fixed=said)


def test_codes_may_be_decided() -> None:
    compiled = CompiledFormat(TRAJ_ONLY.format, VOCABULARY)
    values = Values({"trajectory": ((3, 1, 4, 1, 5, 9),)})
    forced, cursor = compiled.start(fixed=values.by_section).forced()
    assert cursor.done
    assert forced == compiled.render(values)
    with pytest.raises(FormatError, match=r"6 codes are needed, not \(1, 2\)"):
        compiled.start(fixed={"trajectory": ((1, 2),)})


@given(cf_vla_values())
def test_no_response_is_longer_than_the_longest(values: Values) -> None:
    assert len(COMPILED.render(values)) <= COMPILED.longest()


def test_the_longest_is_no_wild_guess() -> None:
    times = [format_tick(tick) for tick in (*range(0, 5 * MAX_SEGMENTS, 5), TICKS)]
    text = ""
    for group in GROUPS:
        longest = cycle(sorted(WORDS[group], key=len, reverse=True)[:2])
        text += f"- {group}\n"
        text += "".join(f"  - {start}s-{end}s: {next(longest)}\n" for start, end in pairwise(times))
    plan = parse_plan(text)
    values = Values.of(
        {
            "plan": plan,
            "branch": "Thinking:",
            "thinking": "x" * MAX_THINKING_TOKENS,
            "revised_plan": plan,
            "trajectory": (0,) * 6,
        }
    )
    assert COMPILED.longest() < 1.1 * len(COMPILED.render(values))
