from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.plan import GROUPS, WORDS, parse_plan
from looktwice.model.families.trajectory_codes import CODES, TRAJECTORY
from looktwice.model.formats.compounds import MAX_REPEATS, Number, Repeat
from looktwice.model.formats.contents import number_alphabets
from looktwice.model.formats.cursor import CompiledFormat, Cursor
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Format,
    FormatError,
    FreeText,
    Literal,
    Maybe,
    Option,
    Piece,
    Record,
    Section,
    Sequence,
    Value,
    Values,
)
from looktwice.model.formats.plan_tracks import PlanTracks
from looktwice.model.formats.text import parse
from tests.model.formats.phrases import PHRASES
from tests.model.formats.strategies import VOCABULARY, Fewer, Listed, Quoted, values_of
from tests.model.formats.test_laws import assert_writable, can_write, ids_of, walk

END = Literal("<|im_end|>")
PHRASED = CompiledFormat(PHRASES, VOCABULARY)
PLAN = parse_plan("".join(f"- {group}\n  - 0.0s-6.4s: {WORDS[group][0]}\n" for group in GROUPS))


def compile_(*parts: Piece) -> CompiledFormat:
    return CompiledFormat(Format("made up", Sequence((*parts, END))), VOCABULARY)


def in_tags(name: str, *parts: Piece) -> Section:
    return Section(name, Sequence((Literal(f"<{name}>"), *parts, Literal(f"</{name}>"))))


def advance(cursor: Cursor, text: str) -> Cursor:
    for token in VOCABULARY.encode(text):
        cursor = cursor.advance(token)
    return cursor


def accepts(compiled: CompiledFormat, text: str) -> bool:
    """Whether the parser does; it must agree with the cursor."""
    try:
        parse(compiled, text)
    except FormatError:
        assert not can_write(compiled, text)
        return False
    assert can_write(compiled, text)
    return True


POSE = Number(-10, 10, 0.1)
THREE = compile_(
    in_tags("answer", Literal("["), POSE, Literal(", "), POSE, Literal(", "), POSE, Literal("]"))
)
SOME = compile_(in_tags("answer", Literal("["), Repeat(POSE, 8, between=", "), Literal("]")))
ANSWER = "<answer>[1.0, -0.5, 0.3]</answer><|im_end|>"


def test_a_section_holds_several_values_in_order() -> None:
    values = parse(THREE, ANSWER)
    assert values.all("answer") == (1.0, -0.5, 0.3)
    assert VOCABULARY.decode(ids_of(THREE.render(values))) == ANSWER
    with pytest.raises(FormatError, match="holds 3 values, not one"):
        values["answer"]


def test_a_repeat_is_one_value() -> None:
    values = parse(SOME, ANSWER)
    assert values["answer"] == (1.0, -0.5, 0.3)
    assert VOCABULARY.decode(ids_of(SOME.render(values))) == ANSWER
    assert parse(SOME, "<answer>[]</answer><|im_end|>")["answer"] == ()
    assert not accepts(SOME, "<answer>[1.0, ]</answer><|im_end|>")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((1.0, 2.0), "needs a value"),
        ((1.0, 2.0, 3.0, 4.0), "more values"),
        ((1.0, 2.0, 0.35), r"0.35 is none of -10 to 10 in steps of 0.1"),
        ((1.0, 2.0, 10.1), "is none of"),
        ((1.0, 2.0, True), "a number is needed"),
    ],
)
def test_other_values_of_a_section_are_refused(values: tuple[Value, ...], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        THREE.render(Values({"answer": values}))


@given(st.data())
def test_phrases_parse_to_what_was_rendered(data: st.DataObject) -> None:
    values = data.draw(values_of(PHRASED))
    tokens = PHRASED.render(values)
    assert parse(PHRASED, VOCABULARY.decode(ids_of(tokens))) == values
    assert_writable(PHRASED, tokens)


@given(st.integers(0, 2**32 - 1))
def test_phrases_that_are_written_parse_and_render_back_to_the_token(seed: int) -> None:
    tokens = walk(PHRASED.start(), seed)
    assert PHRASED.render(parse(PHRASED, VOCABULARY.decode(ids_of(tokens)))) == tokens


def test_a_reflection_in_phrases_reads_back_as_fields() -> None:
    cue = "A lorry is ahead, 12.5 m away, at 3 m/s. A pedestrian is crossing, 8.0 m away. "
    thinking = f"{cue}Going on like this would be too close. I should slow down and stop."
    codes = "".join(text for text in VOCABULARY.texts if text.endswith("_003|>"))
    text = (
        f"Meta Actions:\n{PLAN}Thinking:\n{thinking}\nMeta Actions:\n{PLAN}"
        f"Action:\n<|traj_future_start|>{codes}<|traj_future_end|><|im_end|>"
    )
    assert parse(PHRASED, text)["thinking"] == {
        "cues": (
            {
                "object": " lorry",
                "place": " ahead",
                "distance_m": 12.5,
                "moves": True,
                "speed_ms": 3.0,
            },
            {"object": " pedestrian", "place": " crossing", "distance_m": 8.0, "moves": False},
        ),
        "consequence": " would be too close",
        "correction": " slow down and stop",
    }


def test_a_number_may_be_one_token() -> None:
    compiled = compile_(Section("tenth", Number(-1.0, 1.0, 0.1, "tenth")))
    [token, _] = compiled.render(Values.of({"tenth": -0.7}))
    assert VOCABULARY.texts[token.id] == "<tenth 3>"
    assert parse(compiled, "<tenth 3><|im_end|>")["tenth"] == -0.7


@pytest.mark.parametrize(
    "number", [Number(0, 9, 1), Number(-0.9, 12.5, 0.1), Number(-1.0, 1.0, 0.1, "tenth")]
)
def test_tokens_of_a_number_are_ranked_by_the_least_number_behind_them(number: Number) -> None:
    compiled = compile_(Section("number", number))
    least: dict[int, int] = {}
    for place, text in enumerate(number.texts):
        value = float(text)
        least.setdefault(compiled.render(Values.of({"number": value}))[0].id, place)
    allowed = compiled.start().allowed()
    assert allowed.ranks is not None
    assert list(allowed.ids[np.argsort(allowed.ranks)]) == sorted(least, key=least.__getitem__)


ONLY = compile_(Section("picture", Codes("paint", 3, only=(5, None, 0))))


def test_codes_may_be_told_by_the_format() -> None:
    forced, cursor = ONLY.start().forced()
    assert [VOCABULARY.texts[token.id] for token in forced] == ["<paint 5>"]
    assert len(cursor.allowed().ids) == 8
    text = "<paint 5><paint 7><paint 0><|im_end|>"
    assert accepts(ONLY, text)
    assert parse(ONLY, text)["picture"] == (5, 7, 0)
    assert VOCABULARY.decode(ids_of(ONLY.render(Values.of({"picture": (5, 7, 0)})))) == text


def test_other_codes_than_those_told_are_refused() -> None:
    assert not accepts(ONLY, "<paint 5><paint 7><paint 1><|im_end|>")
    with pytest.raises(FormatError, match="paint code 3 of 3 can only be 0, not 1") as caught:
        parse(ONLY, "<paint 5><paint 7><paint 1><|im_end|>")
    assert (caught.value.line, caught.value.column) == (1, 19)
    with pytest.raises(FormatError, match="section 'picture': paint code 1 of 3 can only be 5, not 0"):
        ONLY.render(Values.of({"picture": (0, 7, 0)}))


@pytest.mark.parametrize(
    ("codes", "message"),
    [
        ((4, None, None), "paint code 1 of 3 can only be 5, not 4"),
        ((5, 8, 0), "paint code 2 is to be 8, which is none of 0 to 7"),
    ],
)
def test_codes_that_cannot_be_written_are_not_decided(codes: tuple[int | None, ...], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        ONLY.start(fixed={"picture": (codes,)})


def test_what_is_decided_adds_to_the_codes_told_by_the_format() -> None:
    forced, cursor = ONLY.start(fixed={"picture": ((None, 3, None),)}).forced()
    assert cursor.done
    assert forced == ONLY.render(Values.of({"picture": (5, 3, 0)}))


XY = Choice((Option("x"), Option("y")))


@pytest.mark.parametrize("piece", [Repeat(Fewer("long", XY), 2, 1), Listed(Fewer("long", XY))])
def test_what_narrows_reaches_into_other_pieces(piece: Piece) -> None:
    long = Section("long", Choice((Option("a"), Option("bb"))))
    compiled = compile_(long, Section("s", Sequence((piece, Literal(".")))))
    assert accepts(compiled, "ay.<|im_end|>")
    assert accepts(compiled, "bbx.<|im_end|>")
    assert not accepts(compiled, "bby.<|im_end|>")


@pytest.mark.parametrize(
    ("piece", "value", "message"),
    [
        (Listed(XY), ("x", "y"), "a value has more values than the format writes: 'y'"),
        (Maybe(Literal("x")), "x", "'x' does not say whether a piece is there"),
    ],
)
def test_what_cannot_be_rendered_cannot_be_decided(piece: Piece, value: Value, message: str) -> None:
    compiled = compile_(Section("s", Sequence((piece, Literal(".")))))
    with pytest.raises(FormatError):
        compiled.render(Values.of({"s": value}))
    with pytest.raises(FormatError, match=message):
        compiled.start(fixed={"s": (value,)})


def test_what_is_narrowed_cannot_be_decided() -> None:
    compiled = compile_(Section("s", Fewer("", XY)))
    with pytest.raises(FormatError, match="what a Fewer says cannot be decided"):
        compiled.start(fixed={"s": ("y",)})


def test_words_have_no_ranks() -> None:
    assert compile_(Section("sign", Choice((Option("a"), Option("b"))))).start().allowed().ranks is None


def test_numbers_spell_what_their_grid_needs() -> None:
    assert Number(-1, 1, 0.5).texts == ("-1.0", "-0.5", "0.0", "0.5", "1.0")
    assert Number(0, 20, 10).texts == ("0", "10", "20")
    assert Number(0.25, 0.75, 0.25).texts == ("0.25", "0.50", "0.75")


def test_the_nearest_number_of_a_grid() -> None:
    grid = Number(-1.0, 2.0, 0.1)
    assert [grid.nearest(number) for number in (0.26, -0.04, -7, 7, 0.3)] == [0.3, 0.0, -1.0, 2.0, 0.3]
    assert str(grid.nearest(-0.01)) == "0.0"


def test_alphabets_of_numbers_are_told() -> None:
    tenth = Number(-1.0, 1.0, 0.1, "tenth", name="tenth")
    within = Section("answer", Repeat(Record(Sequence((Literal("("), tenth, Literal(")")))), 3))
    assert number_alphabets(Choice((Option("a", within), Option("b", Number(0, 9, 1))))) == {"tenth": 21}
    assert number_alphabets(Sequence((Codes("paint", 3, 8), Codes("trajectory", 6)))) == {"paint": 8}
    foreign = Quoted(Listed(Fewer("", Choice((Option("a", tenth), Option("b", Codes("paint", 1, 8)))))))
    assert number_alphabets(Section("answer", foreign)) == {"tenth": 21, "paint": 8}


NUMBER = compile_(Section("speed", Sequence((Number(0, 120, 1), Literal(" km/h")))))


@pytest.mark.parametrize(("text", "fits"), [("1", True), ("12", True), ("120", True), ("121", False)])
def test_a_number_may_be_the_beginning_of_another(text: str, fits: bool) -> None:
    assert accepts(NUMBER, f"{text} km/h<|im_end|>") == fits


WORDS_ = compile_(
    Section(
        "mood",
        Sequence(
            (Choice((Option("lost", Literal("!")), Option("lost in thought"), Option(""))), Literal("."))
        ),
    )
)


@pytest.mark.parametrize(
    ("text", "fits"),
    [
        ("lost!.", True),
        ("lost in thought.", True),
        (".", True),
        ("lost.", False),
        ("lost in thought!.", False),
    ],
)
def test_an_option_may_be_the_beginning_of_another(text: str, fits: bool) -> None:
    assert accepts(WORDS_, f"{text}<|im_end|>") == fits


THINK = compile_(in_tags("think", FreeText("</think>", 20)), Section("answer", POSE), Literal("."))


def think(stop: str, most: int, *, multiline: bool = False) -> CompiledFormat:
    return compile_(Section("think", Sequence((Literal("<think>"), FreeText(stop, most, multiline)))))


@pytest.mark.parametrize(
    ("text", "fits"),
    [
        ("speed < 5", True),
        ("a<", True),
        ("</", True),
        ("</thin ", True),
        ("<</think", True),
        ("</think>", False),
        ("", False),
        ("a\nb", False),
        ("caf\xe9", False),
        ("x" * 20, True),
        ("x" * 21, False),
    ],
)
def test_free_text_may_hold_a_part_of_its_stop(text: str, fits: bool) -> None:
    assert accepts(think("</think>", 20), f"<think>{text}</think><|im_end|>") == fits


def test_the_stop_is_never_spelt_by_other_tokens() -> None:
    cursor = advance(think("</think>", 20).start(), "<think>a")
    for token in VOCABULARY.encode("</") + tuple(map(VOCABULARY.texts.index, "think")):
        cursor = cursor.advance(token)
    with pytest.raises(FormatError, match="not allowed"):
        cursor.advance(VOCABULARY.texts.index(">"))


@pytest.mark.parametrize("stop", ["</think>", "aab", "<|im_end|>"])
@pytest.mark.parametrize("most", [1, 2, 5])
@given(seed=st.integers(0, 2**32 - 1))
def test_a_text_at_its_budget_can_always_be_ended(stop: str, most: int, seed: int) -> None:
    """Whatever it holds, also when nothing but pieces of the stop is written."""
    compiled = think(stop, most)
    cursor, pieces = compiled.start().forced()[1], set(VOCABULARY.encode(stop))
    written = 0
    while cursor.section == "think" and written <= most + len(pieces):
        ids = [token for token in cursor.allowed().ids.tolist() if token in pieces] or cursor.allowed().ids
        cursor = cursor.advance(int(ids[seed % len(ids)]))
        seed, written = seed // 3, written + 1
    assert written <= most + len(VOCABULARY.encode(stop))


def test_free_text_of_several_lines() -> None:
    assert accepts(think("</think>", 9, multiline=True), "<think>a\nb\n\nc</think><|im_end|>")
    with pytest.raises(FormatError, match="must not end as it begins"):
        FreeText("\n\n", 9, multiline=True)


def test_text_that_the_tokenizer_spells_too_long_is_spelt_shorter() -> None:
    """The tokenizer takes "</" first, and is left with single letters."""
    compiled = think("\n", 2)
    tokens = compiled.render(Values.of({"think": "a<" + "th"}))
    assert [VOCABULARY.texts[token.id] for token in tokens[-4:]] == ["a<", "th", "\n", "<|im_end|>"]


CODED = Section("trajectory", Codes(TRAJECTORY, CODES))


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (Codes(TRAJECTORY, 96), "96 codes out of alphabet 'trajectory', which has 6 codebooks"),
        (Codes("sounds", 1), "no alphabet 'sounds'; it has trajectory, paint, tenth"),
        (Number(0, 9, 1, "tenth"), "needs 10 codes"),
        (Codes("paint", 2, only=(None, 8)), "paint code 2 is to be 8, which is none of 0 to 7"),
        (Codes("paint", 2, only=(-1, None)), "paint code 1 is to be -1, which is none of 0 to 7"),
        (Record(CODED), "section 'trajectory' must not stand within a Record"),
        (Repeat(Sequence((POSE, CODED)), 3), "section 'trajectory' must not stand within a Repeat"),
        (Choice((Option("a", Quoted(Listed(CODED))),)), "must not stand within a Quoted"),
        (Fewer("", Choice((Option("a", CODED),))), "must not stand within a Fewer"),
        (Sequence((Choice((Option("a"), Option("ab"))), Literal("b"))), "may begin with b'b' too"),
        (Choice((Option("a"), Option("ab", Literal("!")))), "followed by|end of the response"),
        (Sequence((Maybe(FreeText("\n", 9)), Literal("a"))), "is in doubt"),
        (Sequence((Repeat(Number(0, 9, 1), 3), Literal("0"))), "is in doubt"),
        (Maybe(Literal("")), "must not be empty itself"),
        (Sequence((Section("one", Maybe(Literal("a"))), Section("two", Literal("b")))), "its own section"),
    ],
)
def test_a_format_that_could_be_read_in_two_ways_does_not_compile(part: Piece, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        CompiledFormat(Format("bad", part), VOCABULARY)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Codes(TRAJECTORY, 0), "at least one code"),
        (lambda: Codes("paint", 2, only=(1,)), "2 codes are written, and `only` tells of 1"),
        (lambda: Number(1, 0, 1), "no numbers from"),
        (lambda: Number(0, 1, 0.3), "no whole number of steps"),
        (lambda: Number(0, 1, 1e-5), "more than 10000 numbers"),
        (lambda: Repeat(POSE, MAX_REPEATS + 1), "0 to 64 can be written"),
        (lambda: Repeat(POSE, 1, 2), "2 to 1 repeats"),
        (lambda: Repeat(Literal("a"), 3), "must hold one value"),
        (lambda: Repeat(Sequence((POSE, POSE)), 3), "make a record"),
        (lambda: Repeat(Quoted(Literal("a")), 3), "must hold one value"),
        (lambda: Repeat(Quoted(Sequence((POSE, POSE))), 3), "make a record"),
        (lambda: Record(POSE), "needs a name, as does this Number"),
        (lambda: Record(Sequence((Number(0, 1, 1, name="x"),) * 2)), "two values named 'x'"),
        (lambda: Record(Quoted(POSE)), "needs a name, as does this Number"),
        (lambda: Record(Fewer("", Choice((Option("a"),)))), "needs a name, as does this Choice"),
        (lambda: Choice(()), "options of different texts"),
        (lambda: Choice((Option("a"), Option("a"))), "options of different texts"),
        (lambda: FreeText("", 9), "needs a stop"),
        (lambda: FreeText("\n", 0), "at least one token"),
        (lambda: PlanTracks(("lane", "lateral")), "in this order"),
    ],
)
def test_pieces_that_mean_nothing_are_refused(make: Callable[[], Piece], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        make()


def test_a_record_has_exactly_its_fields() -> None:
    compiled = compile_(
        Section("cue", Record(Sequence((Literal("("), Number(0, 9, 1, name="x"), Literal(")")))))
    )
    assert parse(compiled, "(3)<|im_end|>")["cue"] == {"x": 3.0}
    for record, message in (({}, "needs a value 'x'"), ({"x": 3, "y": 4}, "does not write: y")):
        with pytest.raises(FormatError, match=message):
            compiled.render(Values.of({"cue": record}))
