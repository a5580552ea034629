"""A plan's bullet text as a piece, and plans that the caller gives."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Final

from looktwice.model.driving.direction import (
    KEEP_LANE,
    MIN_TICKS,
    OTHER_LANE,
    Change,
    changed,
    counted,
    gain,
    group_of,
    needed,
    puts_off,
)
from looktwice.model.driving.phrases import Facts, PhraseError, agrees, read_facts
from looktwice.model.driving.plan import (
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
from looktwice.model.driving.plan import Track as DrivingTrack
from looktwice.model.formats.pieces import (
    Choice,
    Compound,
    FormatError,
    Literal,
    Maybe,
    Narrowing,
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
    """A plan's bullet text over ``groups``; only partitions of the horizon can be written.

    Attributes:
        kept: tracks that are forced.
        aims: what other tracks have to reach.
    """

    groups: tuple[Group, ...] = GROUPS
    name: str | None = None
    kept: tuple[tuple[Group, DrivingTrack], ...] = ()
    aims: tuple[Aim, ...] = ()

    def __post_init__(self) -> None:
        if not self.groups or self.groups != tuple(group for group in GROUPS if group in self.groups):
            raise FormatError(f"a plan's groups are some of {', '.join(GROUPS)}, in this order")

    def expand(self) -> Sequence:
        """The plan in simpler pieces."""
        kept, aims = dict(self.kept), {group_of(aim.change): aim for aim in self.aims}
        parts: list[Piece] = []
        for group in self.groups:
            if group in kept:
                parts += _written_out(group, kept[group])
            else:
                start = TrackRest(group, start=0, segments_left=MAX_SEGMENTS, aim=aims.get(group))
                parts += [Literal(f"- {group}\n"), start]
        return Sequence(tuple(parts))

    def join(self, parts: tuple[Value, ...]) -> Plan:
        """The plan of end times and words, as they are read in turns."""
        tracks: dict[str, DrivingTrack] = {**dict(self.kept)}
        texts, start = iter(map(str, parts)), 0
        groups = iter(group for group in self.groups if group not in tracks)
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
        kept = dict(self.kept)
        for group, track in tracks:
            if len(track) > MAX_SEGMENTS:
                raise FormatError(f"track {group} has more than {MAX_SEGMENTS} meta-actions")
            if kept.get(group, track) != track:
                raise FormatError(f"track {group} is to stay as it is: {kept[group]}")
        for aim in self.aims:
            group = group_of(aim.change)
            if not changed(Plan(**{group: aim.first}), value, aim.change):
                raise FormatError(f"track {group} does too little {aim.change}, or too late")
        return tuple(
            text
            for group, track in tracks
            if group not in kept
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
class Aim:
    """What a track has to do more of than the first plan's, as `direction.changed` tells.

    Attributes:
        change: what.
        first: the first plan's track.
        ticks: how much of it is still to do, as `direction.done` counts.
        barred: a word that is not to be written before the change is begun.
    """

    change: Change
    first: DrivingTrack
    ticks: int
    barred: str | None = None

    @classmethod
    def to(cls, change: Change, first: Plan) -> Aim:
        """All of a change that a plan leaves room for."""
        track = first.track(group_of(change)) or ()
        return cls(change, track, needed(first, change), OTHER_LANE.get(change))

    def allows(self, word: str, start: int, end: int, segments_left: int) -> bool:
        """Whether the aim can be reached behind a word from tick to tick, in so many further meta-actions."""
        if word == self.barred or end > self._holds_until(word, start):
            return False
        if puts_off(self.change, self.first, word, start, end, self.ticks):
            return False
        rest, left = self._behind(word, end - start), TICKS - end
        if _most(self.change, word, left, segments_left) < rest.ticks:
            return False
        best = max((each for each in _words(self.change) if each != word), key=partial(gain, self.change))
        if not left or gain(self.change, best) > 0:
            return True
        # The only word that does it has just been written: the next best one comes, as short as possible.
        return rest._holds_until(best, end) >= (TICKS if segments_left == 1 else end + 1)

    def behind(self, word: str, start: int, end: int) -> Aim | None:
        """What is left to do behind a word from tick to tick; None where nothing can go wrong any more."""
        rest = self._behind(word, end - start)
        worst = min(_words(self.change), key=partial(gain, self.change))
        surely = gain(self.change, worst) * (TICKS - end) >= rest.ticks
        return None if surely and rest._holds_until(worst, end) == TICKS else rest

    def _behind(self, word: str, ticks: int) -> Aim:
        gained = gain(self.change, word)
        return replace(self, ticks=self.ticks - ticks * gained, barred=None if gained > 0 else self.barred)

    def _holds_until(self, word: str, start: int) -> int:
        """The last tick up to which a word from ``start`` on is not half a second behind the first plan."""
        if group_of(self.change) != "longitudinal":
            return TICKS
        return _last_tick(self.first, self.change, self.ticks, gain(self.change, word), start)


@lru_cache(1 << 14)
def _last_tick(first: DrivingTrack, change: Change, left: int, gained: int, start: int) -> int:
    """See `Aim._holds_until`: ``left`` is still to do at ``start``, and each tick gains ``gained``."""
    before = counted(first, change)
    done = before[-1] + MIN_TICKS - left
    late = (
        tick
        for tick in range(start + 1, TICKS + 1)
        if done + gained * (tick - start) <= before[tick] - MIN_TICKS
    )
    return next(late, TICKS + 1) - 1


def _words(change: Change) -> tuple[str, ...]:
    return WORDS[group_of(change)]


@cache
def _most(change: Change, previous: str, left: int, segments_left: int) -> int:
    """The most that ``left`` ticks behind a word can do for a change, in so many meta-actions."""
    gains = {word: gain(change, word) for word in _words(change) if word != previous}
    best = max(gains.values())
    if best > 0 or left < 2 or segments_left < 2:
        return best * left
    # The only word that does it stands before, so the next best one comes between, as short as possible.
    return best + left - 1


@dataclass(frozen=True)
class TrackRest(Shorthand):
    """The rest of one track from the tick ``start`` on, in at most ``segments_left`` meta-actions.

    No word follows itself: ``previous`` is the word before ``start``. ``aim`` is what the rest has to reach.
    """

    group: Group
    start: int
    segments_left: int
    previous: str | None = None
    aim: Aim | None = None

    def expand(self) -> Sequence:
        """One meta-action's times in simpler pieces, and its word behind each end time."""
        first = TICKS if self.segments_left == 1 else self.start + 1
        words = (self._word(end) for end in range(first, TICKS + 1))
        ends = tuple(Option(format_tick(word.end), word) for word in words if word.words())
        return Sequence((Literal(f"  - {format_tick(self.start)}s-"), Choice(ends, ordered=True)))

    def _word(self, end: int) -> TrackWord:
        # Without an aim a word does not depend on when it begins.
        start = 0 if self.aim is None else self.start
        return TrackWord(self.group, end, self.segments_left - 1, self.previous, self.aim, start)


@dataclass(frozen=True)
class TrackWord(Shorthand):
    """The word of the meta-action that ends at the tick ``end``, and the rest of its track.

    With an ``aim`` it begins at the tick ``start``.
    """

    group: Group
    end: int
    segments_left: int
    previous: str | None
    aim: Aim | None = None
    start: int = 0

    def expand(self) -> Sequence:
        """The words in simpler pieces; behind each the rest of the track, if there is one."""
        words = []
        for word in self.words():
            aim = self.aim and self.aim.behind(word, self.start, self.end)
            rest = (
                (TrackRest(self.group, self.end, self.segments_left, word, aim),) if self.end < TICKS else ()
            )
            words.append(Option(f" {word}", Sequence((Literal("\n"), *rest))))
        return Sequence((Literal("s:"), Choice(tuple(words))))

    def words(self) -> list[str]:
        """The words that can be written here; with an aim those behind which it can be reached."""
        aim = self.aim
        return [
            word
            for word in WORDS[self.group]
            if word != self.previous
            and (aim is None or aim.allows(word, self.start, self.end, self.segments_left))
        ]


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
            parts += _written_out(group, track)
        return Sequence(tuple(parts))

    def join(self, parts: tuple[Value, ...]) -> Plan:
        """The plan, whatever is read."""
        return plan_from_bins(self.plan.bins())

    def split(self, value: Value) -> tuple[Value, ...]:
        """Nothing: no decision is left."""
        if not isinstance(value, Plan) or value.bins().tolist() != self.plan.bins().tolist():
            raise FormatError(f"another plan is given: {self.plan}")
        return ()


@dataclass(frozen=True)
class RevisedPlan(Narrowing):
    """A plan behind a reflection in phrases: it changes in the directions that are stated, and in no other.

    Tracks that nothing is stated of are those of the first plan, and who is to stay in the lane leaves it
    nowhere.

    Attributes:
        first_plan, reflection: the sections that these are in.
        given: what the plan is, where the caller gives it.
    """

    first_plan: str
    reflection: str
    given: Plan | None = None

    @property
    def sections(self) -> tuple[str, ...]:
        """The first plan's and the reflection's."""
        return self.first_plan, self.reflection

    def expand(self) -> Piece:
        """Any plan."""
        return PlanTracks() if self.given is None else GivenPlan(self.given)

    def narrowed(self, written: Mapping[str, str]) -> Piece:
        """The plans that a reflection leads to; raises `FormatError` where that is not the given one."""
        first, facts = written_plan(written[self.first_plan]), _facts(written[self.reflection])
        if self.given is not None:
            if not agrees(facts, first, self.given):
                raise FormatError(f"the plan behind {str(facts)!r} changes otherwise: {self.given}")
            return GivenPlan(self.given)
        stated = {group_of(change) for change in facts.changes}
        kept = [(group, track) for group, track in first.tracks() if group not in stated]
        aims = [Aim.to(change, first) for change in facts.changes if change != "keep_lane"]
        if "keep_lane" in facts.changes:
            kept.append(("lane", (MetaAction(0, TICKS, KEEP_LANE),)))
        return PlanTracks(kept=tuple(kept), aims=tuple(aims))


def written_plan(text: str) -> Plan:
    """The plan in the text of a section; none of its tracks where it is empty."""
    # The words that lead to a plan's first bullet belong to the format.
    return parse_plan(text[text.index("- ") :]) if "- " in text else Plan()


def _facts(text: str) -> Facts:
    try:
        return read_facts(text.strip("\n"))
    except PhraseError as error:
        raise FormatError(str(error)) from error


def _written_out(group: Group, track: DrivingTrack) -> Iterator[Piece]:
    """A track in the pieces that the model would write it in."""
    yield Literal(f"- {group}\n")
    for action in track:
        texts = (f"  - {format_tick(action.start)}s-", format_tick(action.end))
        yield from map(Literal, (*texts, "s:", f" {action.word}", "\n"))


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
        case Choice(options):
            then = [_with_given(option.then, given, section, left) for option in options]
            new = tuple(Option(option.text, each) for option, each in zip(options, then, strict=True))
            return replace(piece, options=new)
        case Maybe(inner, name):
            return Maybe(_with_given(inner, given, section, left), name)
        case PlanTracks() | RevisedPlan() if section in given:
            left.discard(section)
            plan = given[section]
            for group, track in plan_from_bins(plan.bins()).tracks():
                if len(track) > MAX_SEGMENTS:
                    raise FormatError(
                        f"section {section!r}: track {group} has more meta-actions than the format allows"
                    )
            if isinstance(piece, RevisedPlan):
                return replace(piece, given=plan)
            return GivenPlan(plan, piece.name)
        case _:
            return piece
