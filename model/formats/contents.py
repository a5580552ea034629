"""What a format is made of, in all that its shorthands stand for."""

from __future__ import annotations

from collections.abc import Iterator

from looktwice.model.formats.pieces import Codes, Narrowing, Piece, Shorthand, children
from looktwice.model.formats.plan_tracks import PlanTracks


def contents(piece: Piece) -> Iterator[Piece]:
    """``piece`` and all pieces within it, those that its shorthands stand for too; equal shorthands once.

    Plans are not taken apart: they hold nothing but words, in tens of thousands of pieces.
    """
    known, left = set[Shorthand](), [piece]
    while left:
        each = left.pop()
        if isinstance(each, Shorthand):
            if each in known:
                continue
            known.add(each)
        yield each
        if isinstance(each, Shorthand):
            left += () if isinstance(each, PlanTracks) else (each.expand(),)
        else:
            left += reversed(children(each))


def narrowing_sections(piece: Piece) -> frozenset[str]:
    """The sections whose texts narrow something within ``piece``."""
    narrowings = (each for each in contents(piece) if isinstance(each, Narrowing))
    return frozenset(section for each in narrowings for section in each.sections)


def number_alphabets(piece: Piece) -> dict[str, int]:
    """The alphabets that numbers within ``piece`` are codes of, with how many codes each has.

    Those of all `Codes` whose size is declared count, such as the codes of pictures.
    """
    return {
        each.alphabet: each.size
        for each in contents(piece)
        if isinstance(each, Codes) and each.size is not None
    }
