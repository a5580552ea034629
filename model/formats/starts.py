"""The check that a format can be read without doubt: one character ahead tells which way it goes.

Then tokens tell too, as they begin with different bytes, and parser and cursor accept the same language. A
section ends by its own tokens, so that every token's section is known before it is written.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from looktwice.model.formats.contents import contents
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    FormatError,
    FreeText,
    Literal,
    Maybe,
    Piece,
    Section,
    Sequence,
    Shorthand,
    walk,
)
from looktwice.model.formats.plan_tracks import PlanTracks

if TYPE_CHECKING:
    from looktwice.model.formats.cursor import CompiledFormat


class Start(NamedTuple):
    """What a token may begin with, and the section that it stands in.

    Attributes:
        what: a byte, or the piece whose text begins there; None at the end of the response.
    """

    what: int | FreeText | Codes | None
    section: str


_END: Final = frozenset([Start(None, "")])


def check(compiled: CompiledFormat) -> None:
    """Raise `FormatError` where a format could be read in two ways, lacks an alphabet or hides a section."""
    for piece in walk(compiled.format.body):
        if isinstance(piece, Shorthand):
            _refuse_sections(piece)
    _Checker(compiled).starts(compiled.format.body, "", _END)


def check_codes(compiled: CompiledFormat, piece: Codes) -> None:
    """Raise `FormatError` where a piece does not fit its alphabet, or the vocabulary has none."""
    books = compiled.codebooks(piece.alphabet)
    if len(books) not in (1, piece.count):
        raise FormatError(
            f"{piece.count} codes out of alphabet {piece.alphabet!r}, which has {len(books)} codebooks; "
            "one code of each is written"
        )
    if piece.size is not None and any(len(book) != piece.size for book in books):
        raise FormatError(f"alphabet {piece.alphabet!r} needs {piece.size} codes in each codebook")
    for place, code in enumerate(piece.only or ()):
        size = len(compiled.codebook(piece, place))
        if code is not None and not 0 <= code < size:
            raise FormatError(
                f"{piece.alphabet} code {place + 1} is to be {code}, which is none of 0 to {size - 1}"
            )


def _refuse_sections(shorthand: Shorthand) -> None:
    for piece in contents(shorthand):
        if isinstance(piece, Section):
            raise FormatError(f"section {piece.name!r} must not stand within a {type(shorthand).__name__}")


def first_bytes(compiled: CompiledFormat, piece: Piece) -> frozenset[int]:
    """The bytes that a piece, which is never empty, may begin with."""
    checker = _Checker(compiled)
    return checker.bytes_of(checker.starts(piece, "", frozenset()))


class _Checker:
    def __init__(self, compiled: CompiledFormat) -> None:
        self._compiled = compiled
        # By identity: a repeat holds the same piece many times.
        self._known: dict[tuple[int, str, frozenset[Start]], frozenset[Start]] = {}

    def starts(self, piece: Piece, section: str, follow: frozenset[Start]) -> frozenset[Start]:
        """What ``piece`` may begin with, ``follow`` included where it may be empty."""
        key = (id(piece), section, follow)
        if key not in self._known:
            self._known[key] = self._starts(piece, section, follow)
        return self._known[key]

    def _starts(self, piece: Piece, section: str, follow: frozenset[Start]) -> frozenset[Start]:
        match piece:
            case Literal(text):
                return frozenset([Start(text.encode()[0], section)]) if text else follow
            case Sequence(parts):
                for part in reversed(parts):
                    follow = self.starts(part, section, follow)
                return follow
            case Section(name, body):
                return self.starts(body, name, follow)
            case Choice():
                return self._choice(piece, section, follow)
            case Maybe(inner):
                if self._may_be_empty(inner):
                    raise FormatError("a piece that may be there or not must not be empty itself")
                inside = self.starts(inner, section, follow)
                self._apart("a piece that may be there or not", section, follow, self.bytes_of(inside))
                self._in_section("a piece that may be there or not", section, inside)
                return inside | follow
            case FreeText():
                return frozenset([Start(piece, section)])
            case Codes():
                check_codes(self._compiled, piece)
                return frozenset([Start(piece, section)])
            case PlanTracks():
                # Its times and words are none the beginning of another.
                return frozenset([Start(ord("-"), section)])
            case Shorthand():
                return self.starts(self._compiled.expanded(piece), section, follow)

    def _choice(self, choice: Choice, section: str, follow: frozenset[Start]) -> frozenset[Start]:
        texts = [option.text.encode() for option in choice.options]
        known = set(texts)
        longer: dict[bytes, set[int]] = {}
        for text in texts:
            for size in range(len(text)):
                if text[:size] in known:
                    longer.setdefault(text[:size], set()).add(text[size])
        found: set[Start] = set()
        for option, text in zip(choice.options, texts, strict=True):
            then = self.starts(option.then, section, follow)
            if text in longer:
                what = f"option {option.text!r}, which is a beginning of another,"
                self._apart(what, section, then, frozenset(longer[text]))
            found |= {Start(text[0], section)} if text else then
        return frozenset(found)

    def _apart(self, what: str, section: str, then: frozenset[Start], others: frozenset[int]) -> None:
        """Check that what comes behind ``what`` begins with none of ``others``, in the same section."""
        if any(start.what is None for start in then):
            raise FormatError(f"{what} must not stand at the end of the response")
        self._in_section(what, section, then)
        if both := self.bytes_of(then) & others:
            raise FormatError(f"{what} is in doubt: what follows may begin with {bytes([min(both)])!r} too")

    def _in_section(self, what: str, section: str, starts: frozenset[Start]) -> None:
        if any(start.section != section for start in starts):
            raise FormatError(f"{what} must be followed by text of its own section {section!r}")

    def bytes_of(self, starts: frozenset[Start]) -> frozenset[int]:
        """The bytes that these begin with."""
        found: set[int] = set()
        for start in starts:
            match start.what:
                case int():
                    found.add(start.what)
                case FreeText():
                    found |= self._compiled.text(start.what).alphabet.first_bytes
                case Codes():
                    found |= {
                        text.encode()[0] for text in self._compiled.spellings(start.what, 0).position_of
                    }
        return frozenset(found)

    def _may_be_empty(self, piece: Piece) -> bool:
        match piece:
            case Literal(text):
                return not text
            case Sequence(parts):
                return all(map(self._may_be_empty, parts))
            case Section(_, body):
                return self._may_be_empty(body)
            case Choice(options):
                return any(not option.text and self._may_be_empty(option.then) for option in options)
            case Maybe():
                return True
            case FreeText() | Codes() | PlanTracks():
                return False
            case Shorthand():
                return self._may_be_empty(self._compiled.expanded(piece))
