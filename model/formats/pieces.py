"""The pieces a response format is declared with.

A declaration is a tree of frozen dataclasses. Nothing here knows tokens: `cursor` walks a declaration token
by token, `text` renders and parses it, `grammar_export` turns it into a grammar.

Every `Literal` and every option of a `Choice` is tokenised on its own, in training and in decoding alike, so
forced tokens are by construction the tokens the model was trained on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final
from typing import Literal as Literal_

from model.driving.plan import GROUPS, TICKS, WORDS, Group, Plan, format_tick

Value = Plan | str | tuple[int, ...]
"""What a section holds: a plan, a word or free text, or codes."""
Values = Mapping[str, Value]
"""Section name to value, for the sections that hold one."""

BRANCH: Final = "branch"
"""Name of the choice, and of its section, where a response decides to act or to think."""
ACTION: Final[Literal_["Action:"]] = "Action:"
THINKING: Final[Literal_["Thinking:"]] = "Thinking:"

CODES: Final = 6
"""Trajectory codes of a trajectory (CF-VLA section 8)."""
MAX_SEGMENTS: Final = 12
"""Meta-actions in one track at most: the labeller's shortest is 0.5 s, and responses stay bounded."""


class FormatError(ValueError):
    """Text, tokens or values that do not follow a response format.

    ``line`` and ``column`` count from 1 where text was read.
    """

    def __init__(self, message: str, line: int | None = None, column: int | None = None) -> None:
        super().__init__(message if line is None else f"line {line}, column {column}: {message}")
        self.message, self.line, self.column = message, line, column


@dataclass(frozen=True)
class Literal:
    """Text that is always written."""

    text: str


@dataclass(frozen=True)
class Option:
    """One word of a choice, and what follows when it is taken."""

    text: str
    then: Piece


@dataclass(frozen=True)
class Choice:
    """One of several words. ``name`` lets controls and metrics refer to it."""

    options: tuple[Option, ...]
    name: str | None = None


@dataclass(frozen=True)
class Sequence:
    """Pieces one after the other."""

    parts: tuple[Piece, ...]


@dataclass(frozen=True)
class Section:
    """A named run of tokens; the innermost section names a token."""

    name: str
    body: Piece


@dataclass(frozen=True)
class FreeText:
    """Free words up to ``stop``, which is written after at most ``max_tokens`` tokens."""

    stop: str
    max_tokens: int


@dataclass(frozen=True)
class Codes:
    """``count`` codes, the i-th out of the i-th codebook."""

    count: int = CODES


@dataclass(frozen=True)
class PlanTracks:
    """A plan's bullet text over ``groups``; only partitions of the horizon can be written."""

    groups: tuple[Group, ...] = GROUPS

    def expand(self) -> Sequence:
        """The plan in simpler pieces."""
        return Sequence(
            tuple(
                piece
                for group in self.groups
                for piece in (Literal(f"- {group}\n"), Track(group, start=0, segments_left=MAX_SEGMENTS))
            )
        )


@dataclass(frozen=True)
class Track:
    """The rest of one track from the tick ``start`` on, in at most ``segments_left`` meta-actions.

    No word follows itself: ``previous`` is the word before ``start``.
    """

    group: Group
    start: int
    segments_left: int
    previous: str | None = None

    def expand(self) -> Sequence:
        """One meta-action's times in simpler pieces, and its word behind each end time."""
        first = TICKS if self.segments_left == 1 else self.start + 1
        ends = tuple(
            Option(format_tick(end), TrackWord(self.group, end, self.segments_left - 1, self.previous))
            for end in range(first, TICKS + 1)
        )
        return Sequence((Literal(f"  - {format_tick(self.start)}s-"), Choice(ends)))


@dataclass(frozen=True)
class TrackWord:
    """The word of the meta-action that ends at the tick ``end``, and the rest of its track."""

    group: Group
    end: int
    segments_left: int
    previous: str | None

    def expand(self) -> Sequence:
        """The words in simpler pieces; behind each the rest of the track, if there is one."""
        words = []
        for word in WORDS[self.group]:
            if word != self.previous:
                rest = (Track(self.group, self.end, self.segments_left, word),) if self.end < TICKS else ()
                words.append(Option(f" {word}", Sequence((Literal("\n"), *rest))))
        return Sequence((Literal("s:"), Choice(tuple(words))))


Piece = Literal | Choice | Sequence | Section | FreeText | Codes | PlanTracks | Track | TrackWord


@dataclass(frozen=True)
class Format:
    """A response format: its name as requests give it, and its declaration."""

    name: str
    body: Piece

    def sections(self) -> tuple[str, ...]:
        """The names of all sections, in order of declaration."""
        names: dict[str, None] = {}
        _collect_sections(self.body, names)
        return tuple(names)


def code_text(stage: int, code: int) -> str:
    """How a trajectory code is spelled in text and in the vocabulary."""
    return f"<|traj_{stage}_{code:03d}|>"


def _collect_sections(piece: Piece, names: dict[str, None]) -> None:
    match piece:
        case Section(name, body):
            names[name] = None
            _collect_sections(body, names)
        case Sequence(parts):
            for part in parts:
                _collect_sections(part, names)
        case Choice(options):
            for option in options:
                _collect_sections(option.then, names)
        case _:
            pass
