"""Walking a response format token by token: what is forced, what is allowed, where we are.

A `Cursor` is immutable: draws that have written the same tokens may share one, and forking is free.
No torch here; a vocabulary is anything that satisfies `FormatVocabulary`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.plan import Plan
from looktwice.model.formats.contents import narrowing_sections
from looktwice.model.formats.fixed import FixedValues, with_fixed
from looktwice.model.formats.free_text import BEGUN, Alphabet, TextRules, TextState
from looktwice.model.formats.lengths import longest
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Format,
    FormatError,
    FreeText,
    Literal,
    Maybe,
    Narrowing,
    Piece,
    Section,
    Sequence,
    Shorthand,
    Texts,
    Values,
    walk,
    with_picks,
)
from looktwice.model.formats.plan_tracks import with_given
from looktwice.model.formats.starts import check, check_codes, first_bytes
from looktwice.model.formats.trie import Node, build_trie
from looktwice.model.formats.writing import Token as Token
from looktwice.model.formats.writing import write


class FormatVocabulary(Protocol):
    """What a format needs to know about a tokenizer."""

    @property
    def alphabets(self) -> Mapping[str, tuple[range, ...]]:
        """Named alphabets of codes: for each of its codebooks the ids of its tokens."""
        ...

    def encode(self, text: str) -> tuple[int, ...]:
        """Token ids of ``text`` exactly as given; special tokens are recognised by their spelling."""
        ...

    def decode(self, ids: tuple[int, ...] | list[int]) -> str:
        """The text of tokens, special ones spelt out."""
        ...

    def free_text_ids(self, *, multiline: bool = False) -> npt.NDArray[np.bool_]:
        """Mask over the vocabulary: ordinary tokens that are text on their own, of one line or of several."""
        ...


class ForcedRun(NamedTuple):
    """Within forced tokens."""

    ids: tuple[int, ...]
    position: int


class AtChoice(NamedTuple):
    """Within the words of a choice, at a node of its trie that has children."""

    choice: Choice
    node: Node


class InText(NamedTuple):
    """Within free text."""

    piece: FreeText
    state: TextState


class AtCode(NamedTuple):
    """Before the code at a place."""

    piece: Codes
    place: int


class AtFork(NamedTuple):
    """Where the next token tells which way a response goes: each with what comes behind it."""

    ways: tuple[tuple[Active, Rest], ...]


Active = ForcedRun | AtChoice | InText | AtCode | AtFork
Rest = tuple[Piece, str, "Rest"] | None
"""What comes behind the active piece: a linked list of pieces with the section each stands in."""
Written = tuple[Token, "Written"] | None
"""The tokens written in sections that narrow what comes behind them: a linked list, the last one first."""
_MOST_EXPANDED: Final = 8192
"""Shorthands whose meaning is remembered: those that plans narrow are many."""


@dataclass(frozen=True)
class Allowed:
    """The tokens allowed at a position where there is something to decide.

    Attributes:
        ids: int64 [k], k >= 2, ascending.
        section: the section the token will belong to.
        choice: the name of the choice that is being decided here, where it has one.
        ranks: int64 [k], where a number is decided: which of them each id stands for, counted from the least.
            Where a number takes several tokens, ids count by the least number that begins with them.
    """

    ids: npt.NDArray[np.int64]
    section: str
    choice: str | None = None
    ranks: npt.NDArray[np.int64] | None = None


class CompiledFormat:
    """A format over one vocabulary; tries and tokenised literals are kept between responses.

    Raises:
        FormatError: the format names an alphabet that the vocabulary lacks, or a text in it could be read in
            two ways.
    """

    def __init__(self, format: Format, vocabulary: FormatVocabulary) -> None:
        self.format = format
        self._vocabulary = vocabulary
        self._literals: dict[str, tuple[int, ...]] = {}
        self._tries: dict[tuple[str, ...], Node] = {}
        self._expanded: dict[Shorthand, Piece] = {}
        self._texts: dict[FreeText, TextRules] = {}
        self._free: dict[bool, Alphabet] = {}
        self._codes: dict[range, npt.NDArray[np.int64]] = {}
        self._spellings: dict[range, Texts] = {}
        self._first_bytes: dict[Piece, frozenset[int]] = {}
        self.sentence_ends = frozenset(id for mark in ".!?" for id in self.literal(mark)[-1:])
        """Ids of the tokens that end a sentence."""
        self._narrowing = narrowing_sections(format.body)
        check(self)

    def start(
        self,
        given: Mapping[str, Plan] | None = None,
        picks: Mapping[str, str] | None = None,
        fixed: FixedValues | None = None,
    ) -> Cursor:
        """A cursor at the beginning; plans of the sections in ``given`` are forced, equal neighbours joined.

        Args:
            given: plans by section.
            picks: by the name of a choice, the text of the option that is to be taken.
            fixed: what further sections say; see `with_fixed`.

        Raises:
            FormatError: ``given`` names a section without a plan, or a plan beyond the format; or ``picks`` a
                choice or an option that there is not; or ``fixed`` what a section cannot say.
        """
        body = self.body(given)
        body = with_picks(body, picks) if picks else body
        if fixed:
            body = with_fixed(body, fixed)
            for piece in walk(body):
                if isinstance(piece, Codes):
                    check_codes(self, piece)
        return self._enter((body, "", None), None)

    def body(self, given: Mapping[str, Plan] | None = None) -> Piece:
        """The format's declaration, with the plans of the sections in ``given`` forced; see `start`."""
        return with_given(self.format.body, given) if given else self.format.body

    def render(self, values: Values, given: Mapping[str, Plan] | None = None) -> list[Token]:
        """The tokens of a whole response with these values, each with its section.

        Args:
            values: of all sections, the given ones included.
            given: the response begins at ``start(given)``.

        Raises:
            FormatError: a section's value is missing, too many, or not writable in this format.
        """
        return write(self, self.body(given), values)

    def longest(self) -> int:
        """A number of tokens that no response exceeds."""
        return longest(self, self.format.body)

    def literal(self, text: str) -> tuple[int, ...]:
        """Token ids of a literal."""
        if text not in self._literals:
            self._literals[text] = self._vocabulary.encode(text)
        return self._literals[text]

    def expanded(self, piece: Shorthand) -> Piece:
        """What a shorthand stands for."""
        if piece not in self._expanded:
            if len(self._expanded) >= _MOST_EXPANDED:
                self._expanded.clear()
            self._expanded[piece] = piece.expand()
        return self._expanded[piece]

    def narrowed(self, piece: Narrowing, tokens: Iterable[Token]) -> Piece:
        """What ``piece`` stands for behind tokens; see `Narrowing.narrowed`."""
        ids: dict[str, list[int]] = {section: [] for section in piece.sections}
        for token in tokens:
            if token.section in ids:
                ids[token.section].append(token.id)
        return piece.narrowed({section: self._vocabulary.decode(each) for section, each in ids.items()})

    def noted(self, written: Written, section: str, ids: Iterable[int]) -> Written:
        """``written`` and further tokens, as far as they narrow anything."""
        if section in self._narrowing:
            for token in ids:
                written = (Token(token, section), written)
        return written

    def text(self, piece: FreeText) -> TextRules:
        """What the tokens of a free text may be."""
        if piece not in self._texts:
            encode, decode = self._vocabulary.encode, self._vocabulary.decode
            if piece.multiline not in self._free:
                mask = self._vocabulary.free_text_ids(multiline=piece.multiline)
                self._free[piece.multiline] = Alphabet(mask, lambda ids: decode(list(ids)))
            stop = self.literal(piece.stop)
            self._texts[piece] = TextRules(piece, stop, self._free[piece.multiline], encode)
        return self._texts[piece]

    def codebooks(self, alphabet: str) -> tuple[range, ...]:
        """Ids of an alphabet, by codebook; raises `FormatError` where the vocabulary lacks it."""
        alphabets = self._vocabulary.alphabets
        if alphabet not in alphabets:
            raise FormatError(f"the vocabulary has no alphabet {alphabet!r}; it has {', '.join(alphabets)}")
        return alphabets[alphabet]

    def codebook(self, piece: Codes, place: int) -> range:
        """Ids of the codebook of a place: of all its codes, those included that `Codes.only` leaves out."""
        books = self.codebooks(piece.alphabet)
        return books[place % len(books)]

    def codes(self, piece: Codes, place: int) -> npt.NDArray[np.int64]:
        """Ids of the codes that may stand at a place."""
        book = self.codebook(piece, place)
        if book not in self._codes:
            self._codes[book] = np.arange(book.start, book.stop)
        known, only = self._codes[book], None if piece.only is None else piece.only[place]
        return known if only is None else known[only : only + 1]

    def spellings(self, piece: Codes, place: int) -> Texts:
        """The texts of the codebook of a place."""
        book = self.codebook(piece, place)
        if book not in self._spellings:
            self._spellings[book] = Texts(self._vocabulary.decode([token]) for token in book)
        return self._spellings[book]

    def first_bytes(self, piece: Piece) -> frozenset[int]:
        """The bytes that a piece, which is never empty, may begin with."""
        if piece not in self._first_bytes:
            self._first_bytes[piece] = first_bytes(self, piece)
        return self._first_bytes[piece]

    def trie(self, choice: Choice) -> Node:
        """The trie over a choice's tokenised options."""
        texts = tuple(option.text for option in choice.options)
        if texts not in self._tries:
            self._tries[texts] = build_trie(texts, self.literal)
        return self._tries[texts]

    def _enter(self, rest: Rest, written: Written) -> Cursor:
        """The cursor at the first token of ``rest``."""
        while rest is not None:
            piece, section, after = rest
            match piece:
                case Literal(text):
                    if ids := self.literal(text):
                        return Cursor(self, ForcedRun(ids, 0), section, after, written)
                    rest = after
                case Sequence(parts):
                    for part in reversed(parts):
                        after = (part, section, after)
                    rest = after
                case Section(name, body):
                    rest = (body, name, after)
                case Choice():
                    return self._at_node(piece, self.trie(piece), section, after, written)
                case Maybe(inner):
                    there = self._enter((inner, section, after), written)
                    return self._either(there, self._enter(after, written))
                case FreeText():
                    return Cursor(self, InText(piece, BEGUN), section, after, written)
                case Codes():
                    return Cursor(self, AtCode(piece, 0), section, after, written)
                case Narrowing():
                    rest = (self.narrowed(piece, reversed(list(_each(written)))), section, after)
                case Shorthand():
                    rest = (self.expanded(piece), section, after)
        return Cursor(self, None, "", None, written)

    def _at_node(self, choice: Choice, node: Node, section: str, rest: Rest, written: Written) -> Cursor:
        """The cursor at a node of a choice's trie; where an option may end there, also behind it."""
        if node.option is None:
            return Cursor(self, AtChoice(choice, node), section, rest, written)
        then = self._enter((choice.options[node.option].then, section, rest), written)
        if not node.children:
            return then
        return self._either(Cursor(self, AtChoice(choice, node), section, rest, written), then)

    def _either(self, one: Cursor, other: Cursor) -> Cursor:
        """The cursor where the next token tells which of two it is; `check` makes sure that it can."""
        ways: list[tuple[Active, Rest]] = []
        for cursor in (one, other):
            assert cursor.active is not None
            ways += (
                cursor.active.ways if isinstance(cursor.active, AtFork) else [(cursor.active, cursor.rest)]
            )
        return Cursor(self, AtFork(tuple(ways)), one.section, None, one.written)


@dataclass(frozen=True, eq=False)
class Cursor:
    """A position in a response. Made by `CompiledFormat.start` and `advance`."""

    compiled: CompiledFormat = field(repr=False)
    active: Active | None
    """The piece that the next token belongs to, and where in it; None at the end."""
    section: str
    """The section the next token belongs to."""
    rest: Rest = field(repr=False)
    """What comes behind the active piece; None where that is told with its `AtFork`."""
    written: Written = field(default=None, repr=False)
    """What narrows the pieces that are still to come."""

    @property
    def done(self) -> bool:
        """Whether the response is complete."""
        return self.active is None

    @property
    def ending(self) -> bool:
        """Whether only forced tokens are left."""
        return isinstance(self.active, ForcedRun) and self.rest is None

    def allowed(self) -> Allowed:
        """What may come next; a single id means the token is forced. Not to be called when done."""
        name: str | None = None
        ranks: npt.NDArray[np.int64] | None = None
        match self.active:
            case ForcedRun(ids, position):
                allowed = np.array([ids[position]], np.int64)
            case AtChoice(choice, node):
                allowed, name = node.ids, choice.name
                ranks = node.ranks if choice.ordered else None
            case InText(piece, state):
                allowed = self.compiled.text(piece).allowed(state)
            case AtCode(piece, place):
                allowed = self.compiled.codes(piece, place)
                ranks = np.arange(len(allowed)) if piece.ordered else None
            case AtFork():
                allowed = np.sort(np.concatenate([way.allowed().ids for way in self._ways()]))
            case None:
                raise FormatError("the response is complete")
        return Allowed(allowed, self.section, name, ranks)

    def forced(self) -> tuple[list[Token], Cursor]:
        """The run of forced tokens from here, and the cursor behind it."""
        run: list[Token] = []
        cursor = self
        while not cursor.done:
            if isinstance(cursor.active, ForcedRun):
                ids, position = cursor.active
                run += [Token(token, cursor.section) for token in ids[position:]]
                written = self.compiled.noted(cursor.written, cursor.section, ids[position:])
                cursor = cursor.compiled._enter(cursor.rest, written)
                continue
            allowed = cursor.allowed().ids
            if len(allowed) != 1:
                break
            run.append(Token(int(allowed[0]), cursor.section))
            cursor = cursor.advance(int(allowed[0]))
        return run, cursor

    def advance(self, token: int) -> Cursor:
        """The cursor behind ``token``; raises `FormatError` when it is not allowed here."""
        written = self.compiled.noted(self.written, self.section, (token,))
        match self.active:
            case ForcedRun(ids, position) if ids[position] == token:
                if position + 1 < len(ids):
                    return self._at(ForcedRun(ids, position + 1), written)
                return self.compiled._enter(self.rest, written)
            case AtChoice(choice, node) if token in node.children:
                then = node.children[token]
                return self.compiled._at_node(choice, then, self.section, self.rest, written)
            case InText(piece, state):
                rules = self.compiled.text(piece)
                behind = rules.after(state, token)
                if behind is not None:
                    if behind.matched < rules.end:
                        return self._at(InText(piece, behind), written)
                    if rules.end < len(rules.stop):
                        return self._at(ForcedRun(rules.stop, rules.end), written)
                    return self.compiled._enter(self.rest, written)
            case AtCode(piece, place) if _holds(self.compiled.codes(piece, place), token):
                if place + 1 < piece.count:
                    return self._at(AtCode(piece, place + 1), written)
                return self.compiled._enter(self.rest, written)
            case AtFork():
                for way in self._ways():
                    if _holds(way.allowed().ids, token):
                        return way.advance(token)
        raise FormatError(f"token {token} is not allowed in section {self.section or 'end'!r}")

    def option_texts(self, token: int) -> tuple[str, ...]:
        """At a choice: the options still reachable when ``token`` is taken."""
        if not isinstance(self.active, AtChoice):
            raise FormatError("not at a choice")
        choice, node = self.active
        return tuple(choice.options[position].text for position in node.children[token].options())

    @property
    def stop_id(self) -> int | None:
        """Within free text: the token that ends it, or brings its end nearer; None elsewhere."""
        if isinstance(self.active, InText):
            piece, state = self.active
            return self.compiled.text(piece).stop[state.matched]
        return None

    @property
    def text_tokens(self) -> int | None:
        """Within free text: how many of its tokens are written; None elsewhere."""
        return self.active.state.used if isinstance(self.active, InText) else None

    @property
    def codes_written(self) -> int | None:
        """Before a code: how many of its piece are written, decided ones left out; None elsewhere."""
        if not isinstance(self.active, AtCode):
            return None
        only, place = self.active.piece.only, self.active.place
        return place if only is None else only[:place].count(None)

    @property
    def stop_characters(self) -> int:
        """Within free text: with how many characters of its stop it ends, so that they may not be of it."""
        return self.active.state.seen if isinstance(self.active, InText) else 0

    def _at(self, active: Active, written: Written) -> Cursor:
        return Cursor(self.compiled, active, self.section, self.rest, written)

    def _ways(self) -> list[Cursor]:
        assert isinstance(self.active, AtFork)
        return [
            Cursor(self.compiled, active, self.section, rest, self.written)
            for active, rest in self.active.ways
        ]


def _each(written: Written) -> Iterator[Token]:
    while written is not None:
        token, written = written
        yield token


def _holds(ids: npt.NDArray[np.int64], token: int) -> bool:
    position = int(np.searchsorted(ids, token))
    return position < len(ids) and int(ids[position]) == token
