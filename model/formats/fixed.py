"""Formats in which sections say what was decided beforehand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeAlias, cast

from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Compound,
    FormatError,
    Literal,
    Maybe,
    Narrowing,
    Piece,
    Record,
    Section,
    Sequence,
    Shorthand,
    Value,
    walk,
)
from looktwice.model.formats.writing import ByName, InOrder, ValueSource

Decided: TypeAlias = "Value | tuple[int | None, ...]"
"""A value; of codes, some places may be left open."""
FixedValues: TypeAlias = Mapping[str, tuple[Decided, ...]]
"""By section its first values, in order; those behind them are left open."""


def with_fixed(body: Piece, fixed: FixedValues) -> Piece:
    """``body`` with the first values of sections decided: nothing else can be written there.

    Raises:
        FormatError: there is no such section, or it stands in several places, or it cannot say this.
    """
    places = Counter(piece.name for piece in walk(body) if isinstance(piece, Section))
    for name in fixed:
        if places[name] > 1:
            raise FormatError(f"section {name!r} stands in {places[name]} places")
    # Codes that are left open are looked at nowhere but in `_decided`.
    values = cast("Mapping[str, tuple[Value, ...]]", fixed)
    sources = {name: InOrder(each, f"section {name!r}") for name, each in values.items()}
    found = _decided(body, sources.get(""), sources)
    for source in sources.values():
        source.finish()
    return found


def _decided(piece: Piece, values: ValueSource | None, sources: Mapping[str, ValueSource]) -> Piece:
    """``piece`` as it writes the values that it takes, and as it is where there are none left."""
    match piece:
        case Section(name, body):
            return Section(name, _decided(body, sources.get(name), sources))
        case Sequence(parts):
            return Sequence(tuple(_decided(part, values, sources) for part in parts))
        case Literal():
            return piece
        case Choice(options) if values is None or not values.left:
            then = (replace(each, then=_decided(each.then, values, sources)) for each in options)
            return replace(piece, options=tuple(then))
        case Maybe(inner, name) if values is None or not values.left:
            return Maybe(_decided(inner, values, sources), name)
        case _ if values is None or not values.left:
            return piece
        case Choice(options, name):
            text = values.take(name)
            for option in options:
                if option.text == text:
                    return Sequence((Literal(option.text), _decided(option.then, values, sources)))
            raise FormatError(f"{text!r} is none of {', '.join(option.text for option in options)}")
        case Maybe(inner, name):
            there = values.take(name)
            if not isinstance(there, bool):
                raise FormatError(f"{there!r} does not say whether a piece is there")
            return _decided(inner, values, sources) if there else Literal("")
        case Codes():
            codes = values.take(piece.name)
            if not isinstance(codes, tuple) or len(codes) != piece.count:
                raise FormatError(f"{piece.count} codes are needed, not {codes!r}")
            return _with_codes(piece, cast("tuple[int | None, ...]", codes))
        case Record(body, name):
            record = values.take(name)
            if not isinstance(record, Mapping):
                raise FormatError(f"{record!r} is no record")
            fields = ByName(record)
            decided = _decided(body, fields, sources)
            fields.finish()
            return decided
        case Compound():
            within = InOrder(piece.split(values.take(piece.name)), "a value")
            decided = _decided(piece.expand(), within, sources)
            within.finish()
            return decided
        case Shorthand() if not isinstance(piece, Narrowing):
            return _decided(piece.expand(), values, sources)
        case _:
            raise FormatError(f"what a {type(piece).__name__} says cannot be decided")


def _with_codes(piece: Codes, codes: tuple[int | None, ...]) -> Codes:
    """``piece`` with further codes decided; raises `FormatError` where it can only write others."""
    for place, code in enumerate(codes):
        if code is not None:
            piece.check(place, code)
    before = piece.only or (None,) * piece.count
    return replace(
        piece, only=tuple(old if new is None else new for old, new in zip(before, codes, strict=True))
    )
