"""Random plans, responses and formats."""

from __future__ import annotations

import string
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

from hypothesis import assume
from hypothesis import strategies as st

from looktwice.model.driving.plan import GROUPS, TICKS, WORDS, Group, MetaAction, Plan, plan_from_bins
from looktwice.model.families.cf_vla.format import ACTION, BRANCH, THINKING
from looktwice.model.families.trajectory_codes import CODES, TRAJECTORY
from looktwice.model.formats.compounds import Number, Repeat
from looktwice.model.formats.cursor import CompiledFormat, FormatVocabulary
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Compound,
    Format,
    FormatError,
    FreeText,
    Literal,
    Maybe,
    Narrowing,
    Option,
    Piece,
    Record,
    Section,
    Sequence,
    Shorthand,
    Value,
    Values,
    holds,
)
from looktwice.model.formats.plan_tracks import MAX_SEGMENTS, PlanTracks
from tests.model.formats.vocabulary import PAINTS, TENTHS, ByteVocabulary


@st.composite
def plans(draw: st.DrawFn, groups: tuple[Group, ...] = GROUPS) -> Plan:
    """Plans with all of some groups, equal neighbours joined."""
    tracks = {}
    for group in groups:
        cuts = draw(st.sets(st.integers(1, TICKS - 1), max_size=MAX_SEGMENTS - 1))
        edges = [0, *sorted(cuts), TICKS]
        tracks[group] = tuple(
            MetaAction(start, end, draw(st.sampled_from(WORDS[group]))) for start, end in pairwise(edges)
        )
    return plan_from_bins(Plan(**tracks).bins())


@st.composite
def cf_vla_values(draw: st.DrawFn, codes: int = 16) -> Values:
    """Values of a whole CF-VLA response."""
    values: dict[str, Value] = {
        "plan": draw(plans()),
        "branch": draw(st.sampled_from(["Action:", "Thinking:"])),
        "trajectory": tuple(draw(st.lists(st.integers(0, codes - 1), min_size=CODES, max_size=CODES))),
    }
    if values["branch"] == "Thinking:":
        alphabet = string.ascii_letters + string.digits + " ,.-"
        values["thinking"] = draw(st.text(alphabet, min_size=1, max_size=60))
        values["revised_plan"] = draw(plans())
    return Values.of(values)


_LEADS = st.text(string.ascii_letters + " :,", max_size=30).map(Literal)
_STOPS = st.sampled_from(["\n", "\n\n", "\nSo:\n", "</think>", "<|im_end|>", "aab"])
_MOODS = ("calm", "hasty", "wary", "lost in thought", "lost", "calmer than before")


@st.composite
def branching_formats(draw: st.DrawFn) -> Format:
    """Formats with a plan and a branch, and by chance with notes and words to choose from in other places."""

    def text(name: str) -> Section:
        return Section(name, Sequence((draw(_LEADS), FreeText(draw(_STOPS), draw(st.integers(1, 60))))))

    def plan(name: str, groups: tuple[Group, ...]) -> Section:
        return Section(name, Sequence((draw(_LEADS), Literal("\n"), PlanTracks(groups))))

    def mood(then: Piece) -> Section:
        words = draw(st.lists(st.sampled_from(_MOODS), unique=True, min_size=1))
        options = tuple(Option(f" {word}", Literal(draw(st.sampled_from([";", ";!\n"])))) for word in words)
        name = draw(st.sampled_from([None, "mood"]))
        return Section("mood", Sequence((Literal("Mood:"), Choice(options, name), then)))

    some = draw(st.sets(st.sampled_from(GROUPS), min_size=1))
    groups = tuple(group for group in GROUPS if group in some)
    end = Section("trajectory", Sequence((draw(_LEADS), Codes(TRAJECTORY, CODES), Literal("<|im_end|>"))))
    before = [text("note")] if draw(st.booleans()) else []
    between = [mood(draw(_LEADS))] if draw(st.booleans()) else []
    again = draw(st.lists(st.sampled_from(["revised", "mood", "note"]), unique=True))
    made: dict[str, Piece] = {
        "revised": plan("revised_plan", groups),
        "mood": mood(Literal("")),
        "note": text("second_note"),
    }
    ways = (
        Option(ACTION, end),
        Option(THINKING, Sequence((text("thinking"), *(made[name] for name in again), end))),
    )
    branch = Section(BRANCH, Choice(tuple(draw(st.permutations(ways))), BRANCH))
    return Format("made up", Sequence((*before, plan("plan", groups), *between, branch)))


VOCABULARY = ByteVocabulary()
_TEXTS = st.text("ab1<>/-,. \n;", min_size=1, max_size=3)
_SECTIONS = ["one", "two", "three"]
_WORDS = ["a", "ab", "abc", "b", "lost", "lost in", "1", "12", "</think>", "<", "\n"]


@dataclass(frozen=True)
class Quoted(Shorthand):
    """A shorthand that the language does not know: a piece behind a sign."""

    piece: Piece

    def expand(self) -> Piece:
        return Sequence((Literal(">"), self.piece))


@dataclass(frozen=True)
class Listed(Compound):
    """A compound that the language does not know: all values of a piece as one tuple."""

    piece: Piece
    name: str | None = None

    def expand(self) -> Piece:
        return self.piece

    def join(self, parts: tuple[Value, ...]) -> Value:
        return parts

    def split(self, value: Value) -> tuple[Value, ...]:
        if not isinstance(value, tuple):
            raise FormatError(f"a tuple is needed, not {value!r}")
        return value


@dataclass(frozen=True)
class Fewer(Narrowing):
    """A choice whose last options can be written behind some texts only."""

    section: str
    choice: Choice

    @property
    def sections(self) -> tuple[str, ...]:
        return (self.section,)

    def expand(self) -> Piece:
        return self.choice

    def narrowed(self, written: Mapping[str, str]) -> Piece:
        options = self.choice.options
        return replace(self.choice, options=options[: 1 + len(written[self.section]) % len(options)])


class _Pieces:
    """Draws pieces; ``named`` pieces have names of their own, as records need them."""

    def __init__(self, draw: st.DrawFn, *, codes: bool = True) -> None:
        self._draw, self._names, self._with_codes = draw, 0, codes

    def piece(self, depth: int, *, sections: bool, named: bool = False) -> Piece:
        draw = self._draw
        kinds = ["literal", "text", *(["codes"] if self._with_codes else []), "number", "plan"]
        if depth:
            kinds += ["choice", "maybe", "sequence", "repeat", "record", "quoted", "listed", "fewer"]
            kinds += ["section"] * (2 * sections)
        name = self._name() if named else None
        match draw(st.sampled_from(kinds)):
            case "literal":
                return Literal(draw(_TEXTS))
            case "text":
                stop, budget = (
                    draw(st.sampled_from(["\n", "</", "</think>", "aab", "1", "<|im_end|>"])),
                    (1, 5),
                )
                return FreeText(stop, draw(st.integers(*budget)), draw(st.booleans()), name)
            case "codes":
                alphabet, count, size = draw(
                    st.sampled_from(
                        [
                            (TRAJECTORY, CODES, VOCABULARY.size),
                            ("paint", 1, PAINTS),
                            ("paint", 3, PAINTS),
                            ("tenth", 2, TENTHS),
                        ]
                    )
                )
                code = st.none() | st.integers(0, size - 1)
                only = draw(st.none() | st.tuples(*[code] * count))
                return Codes(alphabet, count, draw(st.sampled_from([None, size])), name, only=only)
            case "number":
                if self._with_codes and draw(st.booleans()):
                    return Number(-1.0, 1.0, 2 / (TENTHS - 1), "tenth", name)
                low, step = draw(st.integers(-12, 12)), draw(st.sampled_from([1, 0.5, 0.25, 5]))
                return Number(low, low + step * draw(st.integers(0, 30)), step, name=name)
            case "plan":
                some = draw(st.sets(st.sampled_from(GROUPS), min_size=1))
                return PlanTracks(tuple(group for group in GROUPS if group in some), name)
            case "choice":
                return self._choice(depth, name, sections=sections)
            case "maybe":
                return Maybe(self.piece(depth - 1, sections=sections, named=named), name)
            case "sequence":
                count = draw(st.integers(0, 3))
                return Sequence(
                    tuple(self.piece(depth - 1, sections=sections, named=named) for _ in range(count))
                )
            case "repeat":
                item = self.piece(depth - 1, sections=False)
                least = draw(st.integers(0, 2))
                most = least + draw(st.integers(not least, 3))
                if holds(item) != 1:
                    item = Record(self.piece(depth - 1, sections=False, named=True))
                return Repeat(item, most, least, draw(st.sampled_from(["", ", ", "\n", "a"])), name)
            case "record":
                return Record(self.piece(depth - 1, sections=False, named=True), name)
            case "quoted":
                return Quoted(self.piece(depth - 1, sections=False, named=named))
            case "listed":
                return Listed(self.piece(depth - 1, sections=False), name)
            case "fewer":
                return Fewer(
                    draw(st.sampled_from(["", *_SECTIONS])), self._choice(depth, name, sections=False)
                )
            case _:
                return Section(draw(st.sampled_from(_SECTIONS)), self.piece(depth - 1, sections=sections))

    def narrowed(self) -> Piece:
        """A section, and behind it a piece that it narrows, by chance within another one."""
        draw, section = self._draw, self._draw(st.sampled_from(_SECTIONS))
        before = Section(section, self._choice(1, None, sections=False))
        fewer = Fewer(section, self._choice(draw(st.integers(0, 2)), None, sections=False))
        ways = [fewer, Quoted(fewer), Listed(fewer), Repeat(Listed(fewer), 2, draw(st.integers(0, 2)), ", ")]
        return Sequence((before, draw(st.sampled_from(ways)), Literal(draw(st.sampled_from(["", "."])))))

    def _choice(self, depth: int, name: str | None, *, sections: bool) -> Choice:
        """A choice between words, and at some depth what follows each."""
        words = self._draw(st.lists(st.sampled_from(["", *_WORDS]), unique=True, min_size=1, max_size=4))
        if not depth:
            return Choice(tuple(map(Option, words)), name)
        then = [self.piece(depth - 1, sections=sections, named=name is not None) for _ in words]
        return Choice(tuple(map(Option, words, then)), name)

    def _name(self) -> str:
        self._names += 1
        return f"value {self._names}"


@st.composite
def compiled_formats(draw: st.DrawFn, vocabulary: FormatVocabulary = VOCABULARY) -> CompiledFormat:
    """Formats made of all pieces, among them only those that can be read without doubt.

    Codes are among the pieces where the vocabulary has any.
    """
    pieces = _Pieces(draw, codes=bool(vocabulary.alphabets))
    parts = [
        pieces.narrowed()
        if draw(st.integers(0, 2)) == 2
        else pieces.piece(draw(st.integers(0, 3)), sections=True)
        for _ in range(draw(st.integers(1, 3)))
    ]
    try:
        body = Sequence((*parts, Literal("<|im_end|>")))
        return CompiledFormat(Format("made up", body), vocabulary)
    except FormatError:
        assume(False)
        raise


@st.composite
def values_of(draw: st.DrawFn, compiled: CompiledFormat) -> Values:
    """Values of a whole response."""
    response = _Response(draw, compiled)
    response.say(compiled.format.body, "", response.values.setdefault("", []))
    return Values({name: tuple(value for _, value in said) for name, said in response.values.items() if said})


_Said = list[tuple[str | None, Value]]


class _Response:
    """Draws values by section; the texts of sections tell what narrows the pieces behind them."""

    def __init__(self, draw: st.DrawFn, compiled: CompiledFormat) -> None:
        self._draw, self._compiled = draw, compiled
        self._texts: dict[str, str] = {}
        self.values: dict[str, _Said] = {}

    def say(self, piece: Piece, section: str, into: _Said) -> None:
        """Draw the values of a piece in a section."""
        draw = self._draw
        match piece:
            case Literal(text):
                self._write(text, section)
            case Sequence(parts):
                for part in parts:
                    self.say(part, section, into)
            case Section(name, body):
                self.say(body, name, self.values.setdefault(name, []))
            case Choice(options, name):
                option = draw(st.sampled_from(options))
                into.append((name, option.text))
                self._write(option.text, section)
                self.say(option.then, section, into)
            case Maybe(inner, name):
                into.append((name, draw(st.booleans())))
                if into[-1][1]:
                    self.say(inner, section, into)
            case FreeText(stop, most, multiline, name):
                letters = sorted({*"ab1 <", *stop, "\n"} if multiline else {*"ab1 <", *stop} - {"\n"})
                text = draw(st.text(letters, min_size=1, max_size=most))
                assume((text + stop).find(stop) == len(text))
                into.append((name, text))
                self._write(text + stop, section)
            case Codes(_, count):
                into.append((piece.name, tuple(self._code(piece, place, section) for place in range(count))))
            case PlanTracks(groups, name):
                plan = draw(plans(groups))
                into.append((name, plan))
                self._write(str(plan), section)
            case Record(body, name):
                fields: _Said = []
                self.say(body, section, fields)
                into.append((name, {str(field): value for field, value in fields}))
            case Compound():
                said: _Said = []
                self.say(self._compiled.expanded(piece), section, said)
                into.append((piece.name, piece.join(tuple(value for _, value in said))))
            case Narrowing():
                written = {name: self._texts.get(name, "") for name in piece.sections}
                self.say(piece.narrowed(written), section, into)
            case Shorthand():
                self.say(self._compiled.expanded(piece), section, into)

    def _code(self, piece: Codes, place: int, section: str) -> int:
        ids = self._compiled.codes(piece, place)
        token = int(ids[self._draw(st.integers(0, len(ids) - 1))])
        code = token - self._compiled.codebook(piece, place).start
        self._write(list(self._compiled.spellings(piece, place).position_of)[code], section)
        return code

    def _write(self, text: str, section: str) -> None:
        self._texts[section] = self._texts.get(section, "") + text
