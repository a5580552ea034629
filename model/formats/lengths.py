"""How long a response can get."""

from __future__ import annotations

from typing import TYPE_CHECKING

from looktwice.model.driving.plan import TICKS, WORDS, Group, format_tick
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    FreeText,
    Literal,
    Maybe,
    Piece,
    Section,
    Sequence,
    Shorthand,
)
from looktwice.model.formats.plan_tracks import MAX_SEGMENTS, PlanTracks

if TYPE_CHECKING:
    from looktwice.model.formats.cursor import CompiledFormat


def longest(compiled: CompiledFormat, piece: Piece) -> int:
    """A number of tokens that ``piece`` of a format never exceeds."""
    match piece:
        case Literal(text):
            return len(compiled.literal(text))
        case Sequence(parts):
            return sum(longest(compiled, part) for part in parts)
        case Section(_, body) | Maybe(body):
            return longest(compiled, body)
        case Choice(options):
            return max(
                len(compiled.literal(option.text)) + longest(compiled, option.then) for option in options
            )
        case FreeText(_, max_tokens):
            return max_tokens + len(compiled.text(piece).stop)
        case Codes(_, count):
            return count
        case PlanTracks(groups):
            return sum(
                len(compiled.literal(f"- {group}\n")) + MAX_SEGMENTS * _longest_line(compiled, group)
                for group in groups
            )
        case Shorthand():
            return longest(compiled, compiled.expanded(piece))


def _longest_line(compiled: CompiledFormat, group: Group) -> int:
    """Tokens of the longest meta-action of a group, all its pieces as `TrackRest` writes them."""
    starts = max(len(compiled.literal(f"  - {format_tick(tick)}s-")) for tick in range(TICKS))
    ends = max(len(compiled.literal(format_tick(tick))) for tick in range(1, TICKS + 1))
    words = max(len(compiled.literal(f" {word}")) for word in WORDS[group])
    return starts + ends + len(compiled.literal("s:")) + words + len(compiled.literal("\n"))
