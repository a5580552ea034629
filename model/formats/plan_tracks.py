"""A plan's bullet text as a piece, and plans that the caller gives."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from model.driving.plan import (
    GROUPS,
    TICKS,
    WORDS,
    Group,
    MetaAction,
    Plan,
    PlanError,
    format_tick,
    parse_plan,
    plan_from_bins,
)
from model.formats.pieces import (
    Choice,
    Compound,
    FormatError,
    Literal,
    Maybe,
    Option,
    Piece,
    Section,
    Sequence,
    Shorthand,
    Value,
)

MAX_SEGMENTS: Final = 12
"""Meta-actions in one track at most: the labeller's shortest is 0.5 s, and responses stay bounded."""

_BULLETS: Final = re.compile(r"(?:(?:  )?- .*\n?)*")


@dataclass(frozen=True)
class PlanTracks(Compound):
    """A plan's bullet text over ``groups``; only partitions of the horizon can be written."""

    groups: tuple[Group, ...] = GROUPS
    name: str | None = None

    def __post_init__(self) -> None:
        if not self.groups or self.groups != tuple(group for group in GROUPS if group in self.groups):
            raise FormatError(f"a plan's groups are some of {', '.join(GROUPS)}, in this order")

    def expand(self) -> Sequence:
        """The plan in simpler pieces."""
        return Sequence(
            tuple(
                piece
                for group in self.groups
                for piece in (Literal(f"- {group}\n"), Track(group, start=0, segments_left=MAX_SEGMENTS))
            )
        )

    def join(self, parts: tuple[Value, ...]) -> Plan:
        """The plan of end times and words, as they are read in turns."""
        tracks: dict[str, tuple[MetaAction, ...]] = {}
        texts, start, groups = iter(map(str, parts)), 0, iter(self.groups)
        actions: list[MetaAction] = []
        for time, word in zip(texts, texts, strict=True):
            end = int(time.replace(".", ""))
            actions.append(MetaAction(start, end, word.removeprefix(" ")))
            start = end % TICKS
            if not start:
                tracks[next(groups)] = tuple(actions)
                actions = []
        return Plan(**tracks)

    def split(self, value: Value) -> tuple[str, ...]:
        """The end times and words of a plan, in turns; equal neighbours are joined first."""
        if not isinstance(value, Plan):
            raise FormatError(f"a plan is needed, not {value!r}")
        tracks = plan_from_bins(value.bins()).tracks()
        if tuple(group for group, _ in tracks) != self.groups:
            raise FormatError(f"a plan with the groups {', '.join(self.groups)} is needed, got {tracks}")
        for group, track in tracks:
            if len(track) > MAX_SEGMENTS:
                raise FormatError(f"track {group} has more than {MAX_SEGMENTS} meta-actions")
        return tuple(
            text
            for _, track in tracks
            for action in track
            for text in (format_tick(action.end), f" {action.word}")
        )

    def explain(self, text: str, line: int) -> FormatError | None:
        """What is wrong with the bullets that ``text`` begins with."""
        bullets = _BULLETS.match(text)
        try:
            parse_plan(bullets[0] if bullets else "", line)
        except PlanError as error:
            return FormatError(error.message, error.line, error.column)
        return None


@dataclass(frozen=True)
class Track(Shorthand):
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
class TrackWord(Shorthand):
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


@dataclass(frozen=True)
class GivenPlan(Compound):
    """A plan that the caller gives: all of it is forced, in the pieces that the model would write it in.

    It may lack groups. Equal neighbours are joined, as no model writes them.
    """

    plan: Plan
    name: str | None = None

    def expand(self) -> Sequence:
        """The plan in literals."""
        plan = plan_from_bins(self.plan.bins())
        parts: list[Piece] = []
        for group, track in plan.tracks():
            parts.append(Literal(f"- {group}\n"))
            for action in track:
                texts = (f"  - {format_tick(action.start)}s-", format_tick(action.end))
                parts += map(Literal, (*texts, "s:", f" {action.word}", "\n"))
        return Sequence(tuple(parts))

    def join(self, parts: tuple[Value, ...]) -> Plan:
        """The plan, whatever is read."""
        return plan_from_bins(self.plan.bins())

    def split(self, value: Value) -> tuple[Value, ...]:
        """Nothing: no decision is left."""
        if not isinstance(value, Plan) or value.bins().tolist() != self.plan.bins().tolist():
            raise FormatError(f"another plan is given: {self.plan}")
        return ()


def with_given(body: Piece, given: Mapping[str, Plan]) -> Piece:
    """``body`` with the plans of given sections forced.

    Raises:
        FormatError: a given section holds no plan, or a plan has more meta-actions than can be written.
    """
    left = set(given)
    found = _with_given(body, given, "", left)
    if left:
        raise FormatError(f"the format has no section {min(left)!r} that holds a plan")
    return found


def _with_given(piece: Piece, given: Mapping[str, Plan], section: str, left: set[str]) -> Piece:
    match piece:
        case Section(name, body):
            return Section(name, _with_given(body, given, name, left))
        case Sequence(parts):
            return Sequence(tuple(_with_given(part, given, section, left) for part in parts))
        case Choice(options, name):
            then = [_with_given(option.then, given, section, left) for option in options]
            return Choice(
                tuple(Option(option.text, each) for option, each in zip(options, then, strict=True)), name
            )
        case Maybe(inner, name):
            return Maybe(_with_given(inner, given, section, left), name)
        case PlanTracks(_, name) if section in given:
            left.discard(section)
            plan = given[section]
            for group, track in plan_from_bins(plan.bins()).tracks():
                if len(track) > MAX_SEGMENTS:
                    raise FormatError(
                        f"section {section!r}: track {group} has more meta-actions than the format allows"
                    )
            return GivenPlan(plan, name)
        case _:
            return piece
