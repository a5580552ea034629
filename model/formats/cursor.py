"""Walking a response format token by token: what is forced, what is allowed, where we are.

A `Cursor` is immutable: draws that have written the same tokens may share one, and forking is free.
No torch here; a vocabulary is anything that satisfies `Vocabulary`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from model.driving.plan import TICKS, WORDS, Group, Plan, format_tick
from model.formats.given import with_given
from model.formats.pieces import (
    MAX_SEGMENTS,
    Choice,
    Codes,
    Format,
    FormatError,
    FreeText,
    Literal,
    Piece,
    PlanTracks,
    Section,
    Sequence,
    Track,
    TrackWord,
    Values,
)
from model.formats.trie import Node, build_trie


class Vocabulary(Protocol):
    """What a format needs to know about a tokenizer."""

    def encode(self, text: str) -> tuple[int, ...]:
        """Token ids of ``text`` exactly as given; special tokens are recognised by their spelling."""
        ...

    def code_ids(self, stage: int) -> range:
        """Ids of the trajectory codes of one stage."""
        ...

    def free_text_ids(self) -> npt.NDArray[np.bool_]:
        """Mask over the vocabulary: ordinary tokens without a line break."""
        ...


class Token(NamedTuple):
    """A token of a response and the section it belongs to."""

    id: int
    section: str


class Run(NamedTuple):
    """Within forced tokens."""

    ids: tuple[int, ...]
    position: int


class AtChoice(NamedTuple):
    """Within the words of a choice, at a node of its trie."""

    choice: Choice
    node: Node


class InText(NamedTuple):
    """Within free text, behind so many of its tokens."""

    piece: FreeText
    used: int


class AtCode(NamedTuple):
    """Before the code of a stage."""

    piece: Codes
    stage: int


Active = Run | AtChoice | InText | AtCode
Rest = tuple[Piece, str, "Rest"] | None
"""What comes behind the active piece: a linked list of pieces with the section each stands in."""


@dataclass(frozen=True)
class Allowed:
    """The tokens allowed at a position where there is something to decide.

    Attributes:
        ids: int64 [k], k >= 2, ascending.
        section: the section the token will belong to.
        choice: the name of the choice that is being decided here, where it has one.
    """

    ids: npt.NDArray[np.int64]
    section: str
    choice: str | None = None


class CompiledFormat:
    """A format over one vocabulary; tries and tokenised literals are kept between responses."""

    def __init__(self, format: Format, vocabulary: Vocabulary) -> None:
        self.format = format
        self._vocabulary = vocabulary
        self._literals: dict[str, tuple[int, ...]] = {}
        self._tries: dict[tuple[str, ...], Node] = {}
        self._expanded: dict[PlanTracks | Track | TrackWord, Sequence] = {}
        self._codes = tuple(np.arange(ids.start, ids.stop) for ids in map(vocabulary.code_ids, range(6)))
        self._free_ids: dict[tuple[str, bool], npt.NDArray[np.int64]] = {}
        self.sentence_ends = frozenset(id for mark in ".!?" for id in self.literal(mark)[-1:])
        """Ids of the tokens that end a sentence."""

    def start(self, given: Values | None = None) -> Cursor:
        """A cursor at the beginning; plans of the sections in ``given`` are forced, equal neighbours joined.

        Raises:
            FormatError: ``given`` names a section without a plan, or a plan beyond the format.
        """
        known = self.format.sections()
        for name in given or {}:
            if name not in known:
                raise FormatError(f"format {self.format.name} has no section {name!r}")
        body = with_given(self.format.body, given or {})
        return self._enter((body, "", None))

    def render(self, values: Values) -> list[Token]:
        """The tokens of a whole response with these values, each with its section.

        Raises:
            FormatError: a section's value is missing or not writable in this format.
        """
        tokens: list[Token] = []
        cursor = self.start({name: value for name, value in values.items() if isinstance(value, Plan)})
        while True:
            forced, cursor = cursor.forced()
            tokens += forced
            if cursor.done:
                return tokens
            for token in cursor.answer(values):
                tokens.append(Token(token, cursor.section))
                cursor = cursor.advance(token)

    def longest(self) -> int:
        """A number of tokens that no response exceeds."""
        return self._longest(self.format.body)

    def _longest(self, piece: Piece) -> int:
        match piece:
            case Literal(text):
                return len(self.literal(text))
            case Sequence(parts):
                return sum(map(self._longest, parts))
            case Section(_, body):
                return self._longest(body)
            case Choice(options):
                return max(len(self.literal(option.text)) + self._longest(option.then) for option in options)
            case FreeText(stop, max_tokens):
                return max_tokens + len(self.literal(stop))
            case Codes(count):
                return count
            case PlanTracks(groups):
                return sum(
                    len(self.literal(f"- {group}\n")) + MAX_SEGMENTS * self._longest_line(group)
                    for group in groups
                )
            case Track() | TrackWord():
                raise TypeError("a track is measured as part of its plan")

    def _longest_line(self, group: Group) -> int:
        """Tokens of the longest meta-action of a group, all its pieces as `Track` writes them."""
        starts = max(len(self.literal(f"  - {format_tick(tick)}s-")) for tick in range(TICKS))
        ends = max(len(self.literal(format_tick(tick))) for tick in range(1, TICKS + 1))
        words = max(len(self.literal(f" {word}")) for word in WORDS[group])
        return starts + ends + len(self.literal("s:")) + words + len(self.literal("\n"))

    def literal(self, text: str) -> tuple[int, ...]:
        """Token ids of a literal."""
        if text not in self._literals:
            self._literals[text] = self._vocabulary.encode(text)
        return self._literals[text]

    def encode(self, text: str) -> tuple[int, ...]:
        """Token ids of free text, which is not kept as literals are."""
        return self._vocabulary.encode(text)

    def free_ids(self, stop: str, *, may_stop: bool) -> npt.NDArray[np.int64]:
        """Ids allowed within free text; with the stop's first token when it may end here."""
        key = (stop, may_stop)
        if key not in self._free_ids:
            mask = self._vocabulary.free_text_ids().copy()
            mask[self.literal(stop)[0]] = may_stop
            self._free_ids[key] = np.flatnonzero(mask)
        return self._free_ids[key]

    def codes(self, stage: int) -> npt.NDArray[np.int64]:
        """Ids of one stage's codes."""
        return self._codes[stage]

    def trie(self, choice: Choice) -> Node:
        """The trie over a choice's tokenised options."""
        texts = tuple(option.text for option in choice.options)
        if texts not in self._tries:
            self._tries[texts] = build_trie(texts, self.literal)
        return self._tries[texts]

    def _enter(self, rest: Rest) -> Cursor:
        """The cursor at the first token of ``rest``."""
        while rest is not None:
            piece, section, after = rest
            match piece:
                case Literal(text):
                    if ids := self.literal(text):
                        return Cursor(self, Run(ids, 0), section, after)
                    rest = after
                case Sequence(parts):
                    for part in reversed(parts):
                        after = (part, section, after)
                    rest = after
                case Section(name, body):
                    rest = (body, name, after)
                case PlanTracks() | Track() | TrackWord():
                    if piece not in self._expanded:
                        self._expanded[piece] = piece.expand()
                    rest = (self._expanded[piece], section, after)
                case Choice():
                    return Cursor(self, AtChoice(piece, self.trie(piece)), section, after)
                case FreeText():
                    return Cursor(self, InText(piece, 0), section, after)
                case Codes():
                    return Cursor(self, AtCode(piece, 0), section, after)
        return Cursor(self, None, "", None)


@dataclass(frozen=True, eq=False)
class Cursor:
    """A position in a response. Made by `CompiledFormat.start` and `advance`."""

    compiled: CompiledFormat = field(repr=False)
    active: Active | None
    """The piece that the next token belongs to, and where in it; None at the end."""
    section: str
    """The section the next token belongs to."""
    rest: Rest = field(repr=False)
    """What comes behind the active piece."""

    @property
    def done(self) -> bool:
        """Whether the response is complete."""
        return self.active is None

    @property
    def ending(self) -> bool:
        """Whether only forced tokens are left."""
        return isinstance(self.active, Run) and self.rest is None

    def allowed(self) -> Allowed:
        """What may come next; a single id means the token is forced. Not to be called when done."""
        name: str | None = None
        match self.active:
            case Run(ids, position):
                allowed = np.array([ids[position]], np.int64)
            case AtChoice(choice, node):
                allowed, name = node.ids, choice.name
            case InText(piece, used):
                if used >= piece.max_tokens:
                    allowed = np.array([self.compiled.literal(piece.stop)[0]], np.int64)
                else:
                    allowed = self.compiled.free_ids(piece.stop, may_stop=used > 0)
            case AtCode(_, stage):
                allowed = self.compiled.codes(stage)
            case None:
                raise FormatError("the response is complete")
        return Allowed(allowed, self.section, name)

    def forced(self) -> tuple[list[Token], Cursor]:
        """The run of forced tokens from here, and the cursor behind it."""
        run: list[Token] = []
        cursor = self
        while not cursor.done:
            if isinstance(cursor.active, Run):
                ids, position = cursor.active
                run += [Token(token, cursor.section) for token in ids[position:]]
                cursor = cursor.compiled._enter(cursor.rest)
                continue
            allowed = cursor.allowed().ids
            if len(allowed) != 1:
                break
            run.append(Token(int(allowed[0]), cursor.section))
            cursor = cursor.advance(int(allowed[0]))
        return run, cursor

    def advance(self, token: int) -> Cursor:
        """The cursor behind ``token``; raises `FormatError` when it is not allowed here."""
        match self.active:
            case Run(ids, position) if ids[position] == token:
                if position + 1 < len(ids):
                    return self._at(Run(ids, position + 1))
                return self.compiled._enter(self.rest)
            case AtChoice(choice, node) if token in node.children:
                child = node.children[token]
                if child.option is None:
                    return self._at(AtChoice(choice, child))
                return self.compiled._enter((choice.options[child.option].then, self.section, self.rest))
            case InText(piece, used):
                stop = self.compiled.literal(piece.stop)
                if token == stop[0] and used > 0:
                    if len(stop) > 1:
                        return self._at(Run(stop, 1))
                    return self.compiled._enter(self.rest)
                ids_allowed = self.compiled.free_ids(piece.stop, may_stop=False)
                if used < piece.max_tokens and _holds(ids_allowed, token):
                    return self._at(InText(piece, used + 1))
            case AtCode(piece, stage) if _holds(self.compiled.codes(stage), token):
                if stage + 1 < piece.count:
                    return self._at(AtCode(piece, stage + 1))
                return self.compiled._enter(self.rest)
        raise FormatError(f"token {token} is not allowed in section {self.section or 'end'!r}")

    def option_texts(self, token: int) -> tuple[str, ...]:
        """At a choice: the options still reachable when ``token`` is taken."""
        if not isinstance(self.active, AtChoice):
            raise FormatError("not at a choice")
        choice, node = self.active
        return tuple(choice.options[position].text for position in node.children[token].options())

    @property
    def stop_id(self) -> int | None:
        """Within free text: the token that ends it; None elsewhere."""
        if isinstance(self.active, InText):
            return self.compiled.literal(self.active.piece.stop)[0]
        return None

    def answer(self, values: Values) -> tuple[int, ...]:
        """The tokens that write the current section's value from here; raises `FormatError`."""
        if self.section not in values:
            raise FormatError(f"section {self.section!r} needs a value")
        value = values[self.section]
        match self.active:
            case AtChoice(choice, _):
                for option in choice.options:
                    if option.text == value:
                        return self.compiled.literal(option.text)
                known = ", ".join(option.text for option in choice.options)
                raise FormatError(f"{value!r} is none of {known}")
            case InText(piece, _) if isinstance(value, str):
                if not value or piece.stop in value:
                    raise FormatError(f"section {self.section!r} must be text without {piece.stop!r}")
                ids = self.compiled.encode(value)
                if len(ids) > piece.max_tokens:
                    raise FormatError(
                        f"section {self.section!r} has {len(ids)} tokens; at most {piece.max_tokens}"
                    )
                # At its budget the text stops by itself: the stop's first token is forced then.
                stop = self.compiled.literal(piece.stop)[:1] if len(ids) < piece.max_tokens else ()
                return ids + stop
            case AtCode(piece, _) if isinstance(value, tuple) and len(value) == piece.count:
                return tuple(int(self.compiled.codes(stage)[code]) for stage, code in enumerate(value))
        raise FormatError(f"section {self.section!r} cannot be written from {value!r}")

    def _at(self, active: Active) -> Cursor:
        return Cursor(self.compiled, active, self.section, self.rest)


def _holds(ids: npt.NDArray[np.int64], token: int) -> bool:
    position = int(np.searchsorted(ids, token))
    return position < len(ids) and int(ids[position]) == token
