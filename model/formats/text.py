"""Reading a response's text back into values, with errors that name line and column."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

from looktwice.model.driving.plan import Plan
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Compound,
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
)

_Parts = list[tuple[str | None, Value]]
"""Values with the names of their pieces, in order."""


def parse(compiled: CompiledFormat, text: str, given: Mapping[str, Plan] | None = None) -> Values:
    """The values of a whole response, of exactly the texts that a cursor can write.

    Args:
        compiled: the format, over a vocabulary: how long free text may be depends on its tokens.
        text: the response.
        given: the response began at ``compiled.start(given)``.

    Raises:
        FormatError: with line and column; also for text behind the response's end.
    """
    reader = _TextReader(compiled, text)
    reader.read(compiled.body(given), reader.section(""))
    if reader.position != len(text):
        raise reader.error("expected the end of the response")
    return reader.values()


def parse_beginning(compiled: CompiledFormat, text: str, given: Mapping[str, Plan] | None = None) -> Values:
    """The values of the beginning of a response, which ends anywhere behind what a cursor has written.

    Sections that are finished have all their values; what is said of the one that is being written may be
    less, or other, than it will be.

    Args:
        compiled, given: as of `parse`.
        text: the response so far.
    """
    reader = _TextReader(compiled, text)
    # What is not written yet cannot be read.
    with suppress(FormatError):
        reader.read(compiled.body(given), reader.section(""))
    return reader.values()


class _TextReader:
    def __init__(self, compiled: CompiledFormat, text: str) -> None:
        self._compiled, self._text, self.position = compiled, text, 0
        self._section, self._texts = "", dict[str, str]()
        self.sections: dict[str, _Parts] = {}

    def section(self, name: str) -> _Parts:
        """The values of a section so far."""
        return self.sections.setdefault(name, [])

    def values(self) -> Values:
        """All that was read so far."""
        return Values(
            {name: tuple(value for _, value in parts) for name, parts in self.sections.items() if parts}
        )

    def read(self, piece: Piece, values: _Parts) -> None:
        """Read ``piece`` from the position on, its values into ``values``."""
        match piece:
            case Literal(text):
                self._literal(text)
            case Sequence(parts):
                for part in parts:
                    self.read(part, values)
            case Section(name, body):
                before, self._section = self._section, name
                self.read(body, self.section(name))
                self._section = before
            case Choice(_, name):
                option = self._option(piece)
                values.append((name, option.text))
                self.read(option.then, values)
            case Maybe(inner, name):
                ahead = self._text[self.position : self.position + 1].encode()
                there = bool(ahead) and ahead[0] in self._compiled.first_bytes(inner)
                values.append((name, there))
                if there:
                    self.read(inner, values)
            case FreeText():
                values.append((piece.name, self._free_text(piece)))
            case Codes():
                values.append((piece.name, self._codes(piece)))
            case Record(body, name):
                fields: _Parts = []
                self.read(body, fields)
                values.append((name, {field: value for field, value in fields if field is not None}))
            case Compound():
                values.append((piece.name, self._compound(piece)))
            case Narrowing():
                written = {section: self._texts.get(section, "") for section in piece.sections}
                try:
                    narrowed = piece.narrowed(written)
                except FormatError as error:
                    raise self.error(error.message) from error
                self.read(narrowed, values)
            case Shorthand():
                self.read(self._compiled.expanded(piece), values)

    def _go_to(self, end: int) -> None:
        """What is up to ``end`` was read; it belongs to the innermost section."""
        read = self._text[self.position : end]
        self._texts[self._section] = self._texts.get(self._section, "") + read
        self.position = end

    def error(self, message: str) -> FormatError:
        """An error at the position."""
        before = self._text[: self.position]
        return FormatError(message, before.count("\n") + 1, self.position - before.rfind("\n"))

    def _literal(self, text: str) -> None:
        if not self._text.startswith(text, self.position):
            found = self._text[self.position : self.position + len(text)]
            raise self.error(f"expected {text!r}, found {found!r}")
        self._go_to(self.position + len(text))

    def _option(self, choice: Choice) -> Option:
        # What follows a shorter option never goes on as a longer one does.
        found = choice.texts.longest_at(self._text, self.position)
        if found is None:
            raise self.error(f"expected one of {', '.join(map(repr, choice.texts.position_of))}")
        position, end = found
        self._go_to(end)
        return choice.options[position]

    def _free_text(self, piece: FreeText) -> str:
        end = self._text.find(piece.stop, self.position)
        if end <= self.position:
            raise self.error(f"expected text that ends with {piece.stop!r}")
        text = self._text[self.position : end]
        try:
            self._compiled.text(piece).spell(text)
        except FormatError as error:
            raise self.error(error.message) from error
        self._go_to(end + len(piece.stop))
        return text

    def _codes(self, piece: Codes) -> tuple[int, ...]:
        codes = []
        for place in range(piece.count):
            found = self._compiled.spellings(piece, place).longest_at(self._text, self.position)
            if found is None:
                raise self.error(f"expected {piece.alphabet} code {place + 1} of {piece.count}")
            code, end = found
            try:
                piece.check(place, code)
            except FormatError as error:
                raise self.error(error.message) from error
            self._go_to(end)
            codes.append(code)
        return tuple(codes)

    def _compound(self, piece: Compound) -> Value:
        start, parts = self.position, list[tuple[str | None, Value]]()
        try:
            self.read(self._compiled.expanded(piece), parts)
        except FormatError as error:
            line = self._text.count("\n", 0, start) + 1
            raise piece.explain(self._text[start:], line) or error from None
        return piece.join(tuple(value for _, value in parts))
