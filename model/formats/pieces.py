"""The pieces a response format is declared with.

A declaration is a tree of frozen dataclasses. Nothing here knows tokens: `cursor` walks a declaration token
by token, `writing` renders values, `text` parses them, `grammar_export` turns it into a grammar.

Every `Literal` and every option of a `Choice` is tokenised on its own, in training and in decoding alike, so
forced tokens are by construction the tokens the model was trained on.

The core pieces are in this module. All others are a `Shorthand`: they expand to core pieces.
"""

from __future__ import annotations

import collections.abc
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, TypeAlias

from looktwice.model.driving.plan import Plan

Value: TypeAlias = "Plan | str | bool | float | tuple[Value, ...] | Mapping[str, Value]"
"""A plan, a word or free text, whether a `Maybe` is there, a number, codes or repeated values, a record."""


Plain: TypeAlias = "str | bool | float | list[Plain] | dict[str, Plain]"
"""A value as JSON writes it."""


def plain(value: Value) -> Plain:
    """A value as JSON writes it; a plan is its text."""
    match value:
        case Plan():
            return str(value)
        case tuple():
            return [plain(each) for each in value]
        case Mapping():
            return {name: plain(each) for name, each in value.items()}
    return value


class FormatError(ValueError):
    """A format that cannot be read without doubt, or text, tokens or values that do not follow a format.

    ``line`` and ``column`` count from 1 where text was read.
    """

    def __init__(self, message: str, line: int | None = None, column: int | None = None) -> None:
        super().__init__(message if line is None else f"line {line}, column {column}: {message}")
        self.message, self.line, self.column = message, line, column


@dataclass(frozen=True)
class Values:
    """What a response says.

    Attributes:
        by_section: section name to its values, in the order in which the format writes them. Sections
            without a value are left out.
    """

    by_section: Mapping[str, tuple[Value, ...]]

    @classmethod
    def of(cls, values: Mapping[str, Value]) -> Values:
        """One value for each section."""
        return cls({section: (value,) for section, value in values.items()})

    def all(self, section: str) -> tuple[Value, ...]:
        """The values of a section, none where it holds none."""
        return self.by_section.get(section, ())

    def get(self, section: str) -> Value | None:
        """The one value of a section; None where it has none. Raises `FormatError` where it has several."""
        return self[section] if section in self.by_section else None

    def __getitem__(self, section: str) -> Value:
        """The one value of a section.

        Raises:
            KeyError: the section has no value.
            FormatError: the section has several values; see `all`.
        """
        values = self.by_section[section]
        if len(values) != 1:
            raise FormatError(f"section {section!r} holds {len(values)} values, not one")
        return values[0]

    def __contains__(self, section: object) -> bool:
        return section in self.by_section

    def __iter__(self) -> Iterator[str]:
        return iter(self.by_section)


NOTHING: Final = Values({})
"""No values at all."""


class Texts:
    """Different texts by their position, to be found within a longer one."""

    def __init__(self, texts: collections.abc.Iterable[str]) -> None:
        self.position_of = {text: position for position, text in enumerate(texts)}
        self._sizes = sorted({len(text) for text in self.position_of}, reverse=True)

    def longest_at(self, text: str, place: int) -> tuple[int, int] | None:
        """The position of the longest of the texts that ``text`` has at a place, and the place behind it."""
        for size in self._sizes:
            found = text[place : place + size]
            if found in self.position_of:
                return self.position_of[found], place + len(found)
        return None


@dataclass(frozen=True)
class Literal:
    """Text that is always written."""

    text: str


@dataclass(frozen=True)
class Option:
    """One word of a choice, and what follows when it is taken."""

    text: str
    then: Piece = Literal("")


@dataclass(frozen=True)
class Choice:
    """One of several words; its value is the option's text.

    An option may be the beginning of another, or empty, if what follows it tells them apart at the first
    character.

    Attributes:
        options: what can be chosen.
        name: lets controls and records refer to the choice.
        ordered: whether the options are evenly spaced numbers, the least one first.
    """

    options: tuple[Option, ...]
    name: str | None = None
    ordered: bool = False

    def __post_init__(self) -> None:
        texts = [option.text for option in self.options]
        if not texts or len(set(texts)) < len(texts):
            raise FormatError(f"a choice needs options of different texts, got {texts}")

    @cached_property
    def texts(self) -> Texts:
        """The texts of the options."""
        return Texts(option.text for option in self.options)


@dataclass(frozen=True)
class Maybe:
    """A piece or nothing; its value is whether the piece is there, before the piece's own values.

    What the piece begins with must differ from what follows it at the first character.
    """

    piece: Piece
    name: str | None = None


@dataclass(frozen=True)
class Sequence:
    """Pieces one after the other."""

    parts: tuple[Piece, ...]


@dataclass(frozen=True)
class Section:
    """A named run of tokens; the innermost section names a token and holds its value."""

    name: str
    body: Piece


@dataclass(frozen=True)
class FreeText:
    """Free words up to ``stop``, which is written after 1 to ``max_tokens`` tokens of text.

    The text never contains the stop, but may hold a part of it, such as the ``<`` of ``</think>``.

    Attributes:
        multiline: whether the text may have several lines.
    """

    stop: str
    max_tokens: int
    multiline: bool = False
    name: str | None = None

    def __post_init__(self) -> None:
        if not self.stop or self.max_tokens < 1:
            raise FormatError("free text needs a stop and at least one token")
        for size in range(1, len(self.stop)):
            border = self.stop[:size]
            if self.stop.endswith(border) and (self.multiline or "\n" not in border):
                # Otherwise the stop could be there twice, overlapping, and where the text ends be in doubt.
                raise FormatError(f"the stop {self.stop!r} of a free text must not end as it begins")


@dataclass(frozen=True)
class Codes:
    """``count`` codes out of a named alphabet of the vocabulary; its value is a tuple of numbers.

    Of an alphabet with several codebooks the i-th code is one of the i-th codebook, and ``count`` is their
    number. Of an alphabet with one codebook every code is one of it.

    Attributes:
        size: codes that each codebook must have; None for any number.
        ordered: whether the codes are evenly spaced numbers, the least one first.
        only: for each place the code that is written there, None where any may be; None for anywhere.
    """

    alphabet: str
    count: int
    size: int | None = None
    name: str | None = None
    ordered: bool = False
    only: tuple[int | None, ...] | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise FormatError(f"at least one code must be written, not {self.count}")
        if self.only is not None and len(self.only) != self.count:
            raise FormatError(f"{self.count} codes are written, and `only` tells of {len(self.only)}")

    def check(self, place: int, code: int) -> None:
        """Raise `FormatError` where only another code than this one is written at a place."""
        only = None if self.only is None else self.only[place]
        if only is not None and code != only:
            raise FormatError(
                f"{self.alphabet} code {place + 1} of {self.count} can only be {only}, not {code}"
            )


class Shorthand(ABC):
    """A piece that stands for simpler pieces, none of them a section. Its dataclass must be frozen."""

    @abstractmethod
    def expand(self) -> Piece:
        """What it stands for, which may hold other shorthands."""


class Compound(Shorthand):
    """A shorthand that makes one value of the values of the pieces that it stands for."""

    name: str | None

    @abstractmethod
    def join(self, parts: tuple[Value, ...]) -> Value:
        """The value of values that were read, in order."""

    @abstractmethod
    def split(self, value: Value) -> tuple[Value, ...]:
        """The inverse of `join`; raises `FormatError` for what is no value of this piece."""

    def explain(self, text: str, line: int) -> FormatError | None:
        """A better error about ``text``, which begins at the first column of ``line`` and does not parse."""
        return None


class Narrowing(Shorthand):
    """A shorthand that stands for less behind some responses: what was written before narrows it.

    `expand` tells all that it may stand for, in whichever response.
    """

    @property
    @abstractmethod
    def sections(self) -> tuple[str, ...]:
        """The sections that narrow it, which must have ended before it."""

    @abstractmethod
    def narrowed(self, written: Mapping[str, str]) -> Piece:
        """What it stands for behind the texts of `sections`; raises `FormatError` where nothing is left."""


@dataclass(frozen=True)
class Record(Shorthand):
    """A piece whose values become one mapping; every piece in it that has a value has a name."""

    body: Piece
    name: str | None = None

    def __post_init__(self) -> None:
        _check_names(self.body, frozenset())

    def expand(self) -> Piece:
        """Its body."""
        return self.body


Piece = Literal | Choice | Maybe | Sequence | Section | FreeText | Codes | Shorthand
"""What a declaration is made of."""


@dataclass(frozen=True)
class Format:
    """A response format: its name as requests give it, and its declaration."""

    name: str
    body: Piece

    def sections(self) -> tuple[str, ...]:
        """The names of all sections, in order of declaration."""
        return tuple(dict.fromkeys(_sections(self.body)))


def holds(piece: Piece) -> int | None:
    """How many values a piece holds; None where that depends on what is written."""
    match piece:
        case Literal() | Section():
            return 0
        case Sequence(parts):
            counts = [holds(part) for part in parts]
            return None if None in counts else sum(filter(None, counts))
        case Choice(options):
            [count, *others] = {holds(option.then) for option in options}
            return None if others or count is None else 1 + count
        case Maybe(inner):
            return 1 if holds(inner) == 0 else None
        case FreeText() | Codes() | Compound() | Record():
            return 1
        case Shorthand():
            return holds(piece.expand())


def children(piece: Piece) -> collections.abc.Sequence[Piece]:
    """The pieces that ``piece`` is declared with; none of a shorthand that stands for others.

    `contents` looks into those, too; they hold no section.
    """
    match piece:
        case Section(_, body) | Record(body):
            return (body,)
        case Sequence(parts):
            return parts
        case Choice(options):
            return [option.then for option in options]
        case Maybe(inner):
            return (inner,)
        case _:
            return ()


def walk(piece: Piece) -> Iterator[Piece]:
    """``piece`` and the pieces within it, those that its shorthands stand for apart."""
    yield piece
    for child in children(piece):
        yield from walk(child)


def choices(piece: Piece) -> Iterator[Choice]:
    """The choices within ``piece``."""
    return (each for each in walk(piece) if isinstance(each, Choice))


def with_picks(body: Piece, picks: Mapping[str, str]) -> Piece:
    """``body`` with choices made beforehand: of each named choice, the option of that text alone is left.

    Raises:
        FormatError: there is no such choice, or it has no such option.
    """
    left = set(picks)
    picked = _with_picks(body, picks, left)
    if left:
        raise FormatError(f"the format has no choice {min(left)!r}")
    return picked


def _with_picks(piece: Piece, picks: Mapping[str, str], left: set[str]) -> Piece:
    match piece:
        case Section(name, body):
            return Section(name, _with_picks(body, picks, left))
        case Sequence(parts):
            return Sequence(tuple(_with_picks(part, picks, left) for part in parts))
        case Choice(options, name):
            if name is not None and name in picks:
                left.discard(name)
                options = tuple(option for option in options if option.text == picks[name])
                if not options:
                    raise FormatError(f"choice {name!r} has no option {picks[name]!r}")
            behind = (replace(each, then=_with_picks(each.then, picks, left)) for each in options)
            return replace(piece, options=tuple(behind))
        case Maybe(inner, name):
            return Maybe(_with_picks(inner, picks, left), name)
        case Record(body, name):
            return Record(_with_picks(body, picks, left), name)
        case _:
            return piece


def _sections(piece: Piece) -> Iterator[str]:
    return (each.name for each in walk(piece) if isinstance(each, Section))


def _check_names(piece: Piece, above: frozenset[str]) -> frozenset[str]:
    """The names of values up to the end of ``piece``; raises `FormatError` for one missing or there twice."""
    if isinstance(piece, Choice | Maybe | FreeText | Codes | Compound | Record):
        if piece.name is None:
            raise FormatError(f"every value of a record needs a name, as does this {type(piece).__name__}")
        if piece.name in above:
            raise FormatError(f"a record has two values named {piece.name!r}")
        above |= {piece.name}
    if isinstance(piece, Choice):
        return above.union(*(_check_names(option.then, above) for option in piece.options))
    if isinstance(piece, Sequence | Maybe):
        for child in children(piece):
            above = _check_names(child, above)
    if isinstance(piece, Shorthand) and not isinstance(piece, Compound | Record):
        return _check_names(piece.expand(), above)
    return above
