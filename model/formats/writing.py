"""Rendering values into the tokens of a response."""

from __future__ import annotations

import collections.abc
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple, Protocol

from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Compound,
    FormatError,
    FreeText,
    Literal,
    Maybe,
    Narrowing,
    Piece,
    Record,
    Section,
    Sequence,
    Shorthand,
    Value,
    Values,
)

if TYPE_CHECKING:
    from looktwice.model.formats.cursor import CompiledFormat


class Token(NamedTuple):
    """A token of a response and the section it belongs to."""

    id: int
    section: str


def write(compiled: CompiledFormat, body: Piece, values: Values) -> list[Token]:
    """The tokens of ``body``, a declaration of ``compiled``, with these values.

    Raises:
        FormatError: a value is missing, too many, or not writable.
    """
    writer = _Writer(compiled, values)
    writer.write(body, "", writer.section(""))
    for section in values:
        writer.section(section).finish()
    return writer.tokens


class ValueSource(Protocol):
    """Values that pieces take."""

    def take(self, name: str | None) -> Value:
        """The next value, or that of a name."""
        ...

    @property
    def left(self) -> bool:
        """Whether there are values that were not taken."""
        ...


class InOrder:
    """Values that are taken one after the other."""

    def __init__(self, values: collections.abc.Sequence[Value], where: str) -> None:
        self._left, self._where = list(reversed(values)), where

    def take(self, name: str | None) -> Value:
        """The next value; raises `FormatError` where there is none."""
        if not self._left:
            raise FormatError(f"{self._where} needs a value")
        return self._left.pop()

    @property
    def left(self) -> bool:
        """Whether there are values that were not taken."""
        return bool(self._left)

    def finish(self) -> None:
        """Raise `FormatError` where values are left."""
        if self._left:
            raise FormatError(f"{self._where} has more values than the format writes: {self._left[-1]!r}")


class ByName:
    """Values that are taken by their names."""

    def __init__(self, values: Mapping[str, Value]) -> None:
        self._left = dict(values)

    def take(self, name: str | None) -> Value:
        """The value of a name; raises `FormatError` where there is none."""
        assert name is not None, "a record's values have names"
        if name not in self._left:
            raise FormatError(f"a record needs a value {name!r}")
        return self._left.pop(name)

    @property
    def left(self) -> bool:
        """Whether there are values that were not taken."""
        return bool(self._left)

    def finish(self) -> None:
        """Raise `FormatError` where values are left."""
        if self._left:
            raise FormatError(f"a record has values that the format does not write: {', '.join(self._left)}")


class _Writer:
    def __init__(self, compiled: CompiledFormat, values: Values) -> None:
        self._compiled, self._values = compiled, values
        self._sections: dict[str, InOrder] = {}
        self.tokens: list[Token] = []

    def section(self, name: str) -> InOrder:
        """The values of a section that are not written yet."""
        if name not in self._sections:
            self._sections[name] = InOrder(self._values.all(name), f"section {name!r}")
        return self._sections[name]

    def write(self, piece: Piece, section: str, source: ValueSource) -> None:
        match piece:
            case Literal(text):
                self._emit(self._compiled.literal(text), section)
            case Sequence(parts):
                for part in parts:
                    self.write(part, section, source)
            case Section(name, body):
                self.write(body, name, self.section(name))
            case Choice(options, name):
                value = source.take(name)
                known = piece.texts.position_of
                if not isinstance(value, str) or value not in known:
                    raise FormatError(f"section {section!r}: {value!r} is none of {', '.join(known)}")
                option = options[known[value]]
                self._emit(self._compiled.literal(option.text), section)
                self.write(option.then, section, source)
            case Maybe(inner, name):
                there = source.take(name)
                if not isinstance(there, bool):
                    raise FormatError(f"section {section!r}: {there!r} does not say whether a piece is there")
                if there:
                    self.write(inner, section, source)
            case FreeText():
                self._text(piece, section, source.take(piece.name))
            case Codes():
                self._codes(piece, section, source.take(piece.name))
            case Record(body, name):
                record = source.take(name)
                if not isinstance(record, Mapping):
                    raise FormatError(f"section {section!r}: {record!r} is no record")
                fields = ByName(record)
                self.write(body, section, fields)
                fields.finish()
            case Compound():
                try:
                    values = piece.split(source.take(piece.name))
                except FormatError as error:
                    raise FormatError(f"section {section!r}: {error}") from error
                within = InOrder(values, f"section {section!r}")
                self.write(self._compiled.expanded(piece), section, within)
                within.finish()
            case Narrowing():
                self.write(self._compiled.narrowed(piece, self.tokens), section, source)
            case Shorthand():
                self.write(self._compiled.expanded(piece), section, source)

    def _text(self, piece: FreeText, section: str, value: Value) -> None:
        if not isinstance(value, str):
            raise FormatError(f"section {section!r}: {value!r} is no text")
        rules = self._compiled.text(piece)
        try:
            self._emit(rules.spell(value) + rules.stop, section)
        except FormatError as error:
            raise FormatError(f"section {section!r}: {error}") from error

    def _codes(self, piece: Codes, section: str, value: Value) -> None:
        if not isinstance(value, tuple) or len(value) != piece.count:
            raise FormatError(
                f"section {section!r} needs {piece.count} codes and cannot be written from {value!r}"
            )
        for place, code in enumerate(value):
            book = self._compiled.codebook(piece, place)
            if isinstance(code, bool) or not isinstance(code, int) or not 0 <= code < len(book):
                raise FormatError(f"section {section!r}: code {code!r} is none of 0 to {len(book) - 1}")
            try:
                piece.check(place, code)
            except FormatError as error:
                raise FormatError(f"section {section!r}: {error}") from error
            self._emit((book[code],), section)

    def _emit(self, ids: tuple[int, ...], section: str) -> None:
        self.tokens += [Token(token, section) for token in ids]
