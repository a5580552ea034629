"""Random plans, responses and formats."""

from __future__ import annotations

import string
from itertools import pairwise

from hypothesis import assume
from hypothesis import strategies as st

from looktwice.model.driving.plan import GROUPS, TICKS, WORDS, Group, MetaAction, Plan, plan_from_bins
from looktwice.model.families.cf_vla.format import ACTION, BRANCH, THINKING
from looktwice.model.families.trajectory_codes import CODES, TRAJECTORY
from looktwice.model.formats.compounds import Number, Repeat
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Compound,
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
    Shorthand,
    Value,
    Values,
    holds,
)
from looktwice.model.formats.plan_tracks import MAX_SEGMENTS, PlanTracks
from tests.model.formats.vocabulary import TENTHS, ByteVocabulary


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
_WORDS = ["a", "ab", "abc", "b", "lost", "lost in", "1", "12", "</think>", "<", "\n"]


class _Pieces:
    """Draws pieces; ``named`` pieces have names of their own, as records need them."""

    def __init__(self, draw: st.DrawFn) -> None:
        self._draw, self._names = draw, 0

    def piece(self, depth: int, *, sections: bool, named: bool = False) -> Piece:
        draw = self._draw
        kinds = ["literal", "text", "codes", "number", "plan"]
        if depth:
            kinds += ["choice", "maybe", "sequence", "repeat", "record"] + ["section"] * (2 * sections)
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
                alphabet, count = draw(
                    st.sampled_from([(TRAJECTORY, CODES), ("paint", 1), ("paint", 3), ("tenth", 2)])
                )
                return Codes(alphabet, count, name=name)
            case "number":
                if draw(st.booleans()):
                    return Number(-1.0, 1.0, 2 / (TENTHS - 1), "tenth", name)
                low, step = draw(st.integers(-12, 12)), draw(st.sampled_from([1, 0.5, 0.25, 5]))
                return Number(low, low + step * draw(st.integers(0, 30)), step, name=name)
            case "plan":
                some = draw(st.sets(st.sampled_from(GROUPS), min_size=1))
                return PlanTracks(tuple(group for group in GROUPS if group in some), name)
            case "choice":
                words = draw(st.lists(st.sampled_from(["", *_WORDS]), unique=True, min_size=1, max_size=4))
                return Choice(
                    tuple(
                        Option(word, self.piece(depth - 1, sections=sections, named=named)) for word in words
                    ),
                    name,
                )
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
            case _:
                section = draw(st.sampled_from(["one", "two", "three"]))
                return Section(section, self.piece(depth - 1, sections=sections))

    def _name(self) -> str:
        self._names += 1
        return f"value {self._names}"


@st.composite
def compiled_formats(draw: st.DrawFn) -> CompiledFormat:
    """Formats made of all pieces, among them only those that can be read without doubt."""
    pieces = _Pieces(draw)
    parts = [pieces.piece(draw(st.integers(0, 3)), sections=True) for _ in range(draw(st.integers(1, 3)))]
    try:
        body = Sequence((*parts, Literal("<|im_end|>")))
        return CompiledFormat(Format("made up", body), VOCABULARY)
    except FormatError:
        assume(False)
        raise


@st.composite
def values_of(draw: st.DrawFn, compiled: CompiledFormat) -> Values:
    """Values of a whole response."""
    values: dict[str, list[tuple[str | None, Value]]] = {}
    _say(draw, compiled, compiled.format.body, values.setdefault("", []), values)
    return Values({name: tuple(value for _, value in said) for name, said in values.items() if said})


_Said = list[tuple[str | None, Value]]


def _say(
    draw: st.DrawFn, compiled: CompiledFormat, piece: Piece, into: _Said, sections: dict[str, _Said]
) -> None:
    match piece:
        case Sequence(parts):
            for part in parts:
                _say(draw, compiled, part, into, sections)
        case Section(name, body):
            _say(draw, compiled, body, sections.setdefault(name, []), sections)
        case Choice(options, name):
            option = draw(st.sampled_from(options))
            into.append((name, option.text))
            _say(draw, compiled, option.then, into, sections)
        case Maybe(inner, name):
            into.append((name, draw(st.booleans())))
            if into[-1][1]:
                _say(draw, compiled, inner, into, sections)
        case FreeText(stop, most, multiline, name):
            letters = sorted({*"ab1 <", *stop, "\n"} if multiline else {*"ab1 <", *stop} - {"\n"})
            text = draw(st.text(letters, min_size=1, max_size=most))
            assume((text + stop).find(stop) == len(text))
            into.append((name, text))
        case Codes(_, count):
            sizes = [len(compiled.codes(piece, place)) for place in range(count)]
            into.append((piece.name, tuple(draw(st.integers(0, size - 1)) for size in sizes)))
        case PlanTracks(groups, name):
            into.append((name, draw(plans(groups))))
        case Record(body, name):
            fields: _Said = []
            _say(draw, compiled, body, fields, sections)
            into.append((name, {str(field): value for field, value in fields}))
        case Compound():
            said: _Said = []
            _say(draw, compiled, compiled.expanded(piece), said, sections)
            into.append((piece.name, piece.join(tuple(value for _, value in said))))
        case Shorthand():
            _say(draw, compiled, compiled.expanded(piece), into, sections)
