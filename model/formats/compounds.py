"""Numbers and repeats, as pieces that expand to core pieces."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property
from typing import Final

from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Compound,
    FormatError,
    Literal,
    Maybe,
    Option,
    Piece,
    Sequence,
    Shorthand,
    Value,
    holds,
)

DIGITS: Final = "digits"
"""The spelling of numbers that are written out."""
MAX_REPEATS: Final = 64
"""Times that a piece can be repeated; for long runs of codes there is `Codes`."""
MAX_NUMBERS: Final = 10_000
"""Numbers of a grid."""
_OFF_GRID: Final = 1e-6
"""Share of a step by which a number may miss the grid."""


@dataclass(frozen=True)
class Number(Compound):
    """A number ``low``, ``low + step``, … ``high``.

    Attributes:
        spelling: `DIGITS` writes it out, such as ``-0.5``, with as many decimals as low and step need. Any
            other spelling names an alphabet with one codebook, whose codes are the numbers, lowest first.
    """

    low: float
    high: float
    step: float
    spelling: str = DIGITS
    name: str | None = None

    def __post_init__(self) -> None:
        low, high, step = (Decimal(str(number)) for number in (self.low, self.high, self.step))
        if not (low.is_finite() and high.is_finite() and step.is_finite() and low <= high and step > 0):
            raise FormatError(f"no numbers from {low} to {high} in steps of {step}")
        if (high - low) % step:
            raise FormatError(f"{high} is no whole number of steps of {step} above {low}")
        if (high - low) / step >= MAX_NUMBERS:
            raise FormatError(f"more than {MAX_NUMBERS} numbers from {low} to {high} in steps of {step}")

    def expand(self) -> Piece:
        """A choice of all numbers, or one code."""
        if self.spelling == DIGITS:
            return Choice(tuple(map(Option, self.texts)), ordered=True)
        return Codes(self.spelling, 1, len(self.texts), ordered=True)

    def join(self, parts: tuple[Value, ...]) -> float:
        """The number of a text or of a code."""
        [part] = parts
        if isinstance(part, str):
            return float(part)
        assert isinstance(part, tuple)
        [code] = part
        assert isinstance(code, int)
        return float(self.texts[code])

    def split(self, value: Value) -> tuple[Value, ...]:
        """The text or the code of a number on the grid."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise FormatError(f"a number is needed, not {value!r}")
        steps = (value - self.low) / self.step
        if not 0 <= round(steps) < len(self.texts) or abs(steps - round(steps)) > _OFF_GRID:
            raise FormatError(f"{value} is none of {self.low} to {self.high} in steps of {self.step}")
        return (self.texts[round(steps)],) if self.spelling == DIGITS else ((round(steps),),)

    def nearest(self, number: float) -> float:
        """The number of the grid that is nearest to a number; the first or the last one beyond its ends."""
        steps = round((min(max(number, self.low), self.high) - self.low) / self.step)
        return float(self.texts[steps])

    @cached_property
    def texts(self) -> tuple[str, ...]:
        """All numbers as text, lowest first."""
        low, high, step = (Decimal(str(number)) for number in (self.low, self.high, self.step))
        exponents = [number.normalize().as_tuple().exponent for number in (low, step)]
        decimals = max(0, *(-exponent for exponent in exponents if isinstance(exponent, int)))
        return tuple(f"{low + place * step:z.{decimals}f}" for place in range(int((high - low) / step) + 1))


@dataclass(frozen=True)
class Repeat(Compound):
    """A piece ``at_least`` to ``at_most`` times; its value is a tuple of the piece's values.

    Attributes:
        piece: holds exactly one value; make a `Record` of several.
        between: text that is written between two.
    """

    piece: Piece
    at_most: int
    at_least: int = 0
    between: str = ""
    name: str | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.at_least <= self.at_most or not 1 <= self.at_most <= MAX_REPEATS:
            raise FormatError(
                f"{self.at_least} to {self.at_most} repeats; 0 to {MAX_REPEATS} can be written, and 1 at most"
            )
        if holds(self.piece) != 1:
            raise FormatError("what is repeated must hold one value; make a record of several")

    def expand(self) -> Piece:
        """Those that must be there, and the rest."""
        return RepeatRest(self, 0)

    def join(self, parts: tuple[Value, ...]) -> tuple[Value, ...]:
        """The repeated values; from `at_least` on each is preceded by whether it is there."""
        return (*parts[: self.at_least], *parts[self.at_least + 1 :: 2])

    def split(self, value: Value) -> tuple[Value, ...]:
        """The inverse of `join`."""
        if not isinstance(value, tuple) or not self.at_least <= len(value) <= self.at_most:
            raise FormatError(f"{self.at_least} to {self.at_most} values are needed, not {value!r}")
        parts = list(value[: self.at_least])
        for part in value[self.at_least :]:
            parts += [True, part]
        return tuple(parts) if len(value) == self.at_most else (*parts, False)


@dataclass(frozen=True)
class RepeatRest(Shorthand):
    """What is left of a repeat behind ``done`` pieces."""

    repeat: Repeat
    done: int

    def expand(self) -> Piece:
        """One more piece, if it must or may be there, and the rest."""
        repeat = self.repeat
        if self.done == repeat.at_most:
            return Literal("")
        between = Literal(repeat.between if self.done else "")
        more = Sequence((between, repeat.piece, RepeatRest(repeat, self.done + 1)))
        return more if self.done < repeat.at_least else Maybe(more)
