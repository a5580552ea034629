"""Reading a response's text back into values, with errors that name line and column."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from model.driving.plan import PlanError, parse_plan
from model.formats.pieces import (
    Choice,
    Codes,
    Format,
    FormatError,
    FreeText,
    Literal,
    Option,
    Piece,
    PlanTracks,
    Section,
    Sequence,
    Track,
    TrackWord,
    Value,
    Values,
)

_CODE = re.compile(r"<\|traj_(\d+)_(\d+)\|>")
_BULLET = re.compile(r"(?:  )?- .*\n?")


def parse(format: Format, text: str) -> Values:
    """The values of a whole response in ``format``.

    Raises:
        FormatError: with line and column; also for text behind the response's end.
    """
    reader = _Reader(text)
    reader.read(format.body, "")
    if reader.position != len(text):
        raise reader.error("expected the end of the response")
    return reader.values


@dataclass
class _Reader:
    text: str
    position: int = 0
    values: dict[str, Value] = field(default_factory=dict)

    def read(self, piece: Piece, section: str) -> None:
        match piece:
            case Literal(text):
                self._literal(text)
            case Sequence(parts):
                for part in parts:
                    self.read(part, section)
            case Section(name, body):
                self.read(body, name)
            case Choice(options):
                option = self._option(options)
                self.values[section] = option.text
                self.position += len(option.text)
                self.read(option.then, section)
            case PlanTracks():
                self._plan(section)
            case FreeText(stop):
                end = self.text.find(stop, self.position)
                if end <= self.position:
                    raise self.error(f"expected text that ends with {stop!r}")
                self.values[section] = self.text[self.position : end]
                self.position = end + len(stop)
            case Codes(count):
                self._codes(count, section)
            case Track() | TrackWord():
                raise TypeError("a track is read as part of its plan")

    def error(self, message: str) -> FormatError:
        before = self.text[: self.position]
        return FormatError(message, before.count("\n") + 1, self.position - before.rfind("\n"))

    def _literal(self, text: str) -> None:
        if not self.text.startswith(text, self.position):
            found = self.text[self.position : self.position + len(text)]
            raise self.error(f"expected {text!r}, found {found!r}")
        self.position += len(text)

    def _option(self, options: tuple[Option, ...]) -> Option:
        for option in options:
            if self.text.startswith(option.text, self.position):
                return option
        raise self.error(f"expected one of {', '.join(repr(option.text) for option in options)}")

    def _plan(self, section: str) -> None:
        start = self.position
        while bullet := _BULLET.match(self.text, self.position):
            self.position = bullet.end()
        line = self.text.count("\n", 0, start) + 1
        try:
            self.values[section] = parse_plan(self.text[start : self.position], line)
        except PlanError as error:
            raise FormatError(error.message, error.line, error.column) from None

    def _codes(self, count: int, section: str) -> None:
        codes = []
        for stage in range(count):
            code = _CODE.match(self.text, self.position)
            if code is None or int(code[1]) != stage:
                raise self.error(f"expected trajectory code {stage + 1} of {count}")
            codes.append(int(code[2]))
            self.position = code.end()
        self.values[section] = tuple(codes)
