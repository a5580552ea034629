"""Plans: time-segmented meta-actions in three groups (CF-VLA sections 3.2 and 8), their text and their IOU.

The text of a plan is a bullet list::

    - longitudinal
      - 0.0s-0.9s: Keep Speed
      - 0.9s-6.4s: Accelerate
    - lateral
      - 0.0s-6.4s: Straight

Times are whole tenths of a second (*ticks*, 0..64); each group's segments partition 0.0 s to 6.4 s.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Group = Literal["longitudinal", "lateral", "lane"]
GROUPS: Final[tuple[Group, ...]] = ("longitudinal", "lateral", "lane")
WORDS: Final[Mapping[Group, tuple[str, ...]]] = {
    "longitudinal": ("Accelerate", "Decelerate", "Keep Speed", "Wait", "Reverse"),
    "lateral": ("Straight", "Left Turn", "Right Turn"),
    "lane": ("Keep Lane", "Left Lane Change", "Right Lane Change"),
}
TICKS: Final = 64
"""Ticks of 0.1 s in the planning horizon of 6.4 s."""

MIRRORED_WORDS: Final[Mapping[str, str]] = {
    "Left Turn": "Right Turn",
    "Right Turn": "Left Turn",
    "Left Lane Change": "Right Lane Change",
    "Right Lane Change": "Left Lane Change",
}


class PlanError(ValueError):
    """A plan that breaks the language's rules; ``line`` and ``column`` count from 1 where text was read."""

    def __init__(self, message: str, line: int | None = None, column: int | None = None) -> None:
        place = "" if line is None else f"line {line}, column {column}: "
        super().__init__(place + message)
        self.message, self.line, self.column = message, line, column


@dataclass(frozen=True)
class MetaAction:
    """One named intent over the ticks ``start`` <= t < ``end``."""

    start: int
    end: int
    word: str

    def __str__(self) -> str:
        return f"{format_tick(self.start)}s-{format_tick(self.end)}s: {self.word}"


Track = tuple[MetaAction, ...]


@dataclass(frozen=True)
class Plan:
    """Three tracks; a group may be absent. Every track that is there partitions the horizon."""

    longitudinal: Track | None = None
    lateral: Track | None = None
    lane: Track | None = None

    def __post_init__(self) -> None:
        for group, track in self.tracks():
            check_track(group, track)

    def track(self, group: Group) -> Track | None:
        """The track of ``group``, or None when the plan does not speak of it."""
        return {"longitudinal": self.longitudinal, "lateral": self.lateral, "lane": self.lane}[group]

    def tracks(self) -> list[tuple[Group, Track]]:
        """The tracks that are there, in the language's order."""
        return [(group, track) for group in GROUPS if (track := self.track(group)) is not None]

    def word_at(self, group: Group, tick: int) -> str | None:
        """The word in force at ``tick``; None where the group is absent."""
        for action in self.track(group) or ():
            if action.start <= tick < action.end:
                return action.word
        return None

    def bins(self) -> npt.NDArray[np.int8]:
        """int8 [3, 64]: each bin's position in its group's words, -1 where the group is absent."""
        table = np.full((len(GROUPS), TICKS), -1, np.int8)
        for group, track in self.tracks():
            for action in track:
                table[GROUPS.index(group), action.start : action.end] = WORDS[group].index(action.word)
        return table

    def mirrored(self) -> Plan:
        """The same plan with left and right exchanged."""
        return Plan(
            **{
                group: tuple(
                    MetaAction(action.start, action.end, MIRRORED_WORDS.get(action.word, action.word))
                    for action in track
                )
                for group, track in self.tracks()
            }
        )

    def __str__(self) -> str:
        return "".join(
            f"- {group}\n" + "".join(f"  - {action}\n" for action in track) for group, track in self.tracks()
        )


def format_tick(tick: int) -> str:
    """``9`` becomes ``0.9``."""
    return f"{tick // 10}.{tick % 10}"


def track_from_words(words: Sequence[str]) -> Track:
    """64 words, one per tick, as a track with equal neighbours joined."""
    edges = [0, *(tick for tick in range(1, len(words)) if words[tick] != words[tick - 1]), len(words)]
    return tuple(MetaAction(start, end, words[start]) for start, end in pairwise(edges))


def plan_from_bins(bins: npt.NDArray[np.integer]) -> Plan:
    """The inverse of `Plan.bins`."""
    return Plan(
        **{
            group: track_from_words([WORDS[group][index] for index in row])
            for group, row in zip(GROUPS, bins, strict=True)
            if row[0] >= 0
        }
    )


def check_track(group: Group, track: Track) -> None:
    """Raise `PlanError` unless ``track`` partitions the horizon with words of ``group``."""
    if not track:
        raise PlanError(f"group {group} has no meta-actions; leave the group out instead")
    expected = 0
    for action in track:
        _check_segment(group, action, expected)
        expected = action.end
    if expected != TICKS:
        raise PlanError(f"group {group} ends at {format_tick(expected)}s, not at {format_tick(TICKS)}s")


def _check_segment(group: Group, action: MetaAction, expected_start: int) -> None:
    if action.word not in WORDS[group]:
        raise PlanError(f"unknown {group} word {action.word!r}; known are {', '.join(WORDS[group])}")
    if action.end > TICKS or action.start < 0:
        raise PlanError(f"{action} lies outside 0.0s-{format_tick(TICKS)}s")
    if action.end <= action.start:
        raise PlanError(f"{action} does not end after it starts")
    if action.start > expected_start:
        raise PlanError(f"gap before {action}: the time before ends at {format_tick(expected_start)}s")
    if action.start < expected_start:
        raise PlanError(f"{action} overlaps the time before, which ends at {format_tick(expected_start)}s")


def plan_iou(one: Plan, other: Plan) -> float:
    """Intersection over union of two plans on 64 x 3 bins (CF-VLA section 4.1), in 0..1.

    A plan is the set of its (group, bin, word) triples; two plans without any group agree fully.
    """
    a, b = one.bins(), other.bins()
    common = int(((a == b) & (a >= 0)).sum())
    union = int((a >= 0).sum()) + int((b >= 0).sum()) - common
    return common / union if union else 1.0


_GROUP_LINE: Final = re.compile(r"- (?P<group>\w+)")
_SEGMENT_LINE: Final = re.compile(r"  - (?P<start>[^\s:]*?)s-(?P<end>[^\s:]*?)s: (?P<word>.*)")
_TIME: Final = re.compile(r"(?:0|[1-9][0-9]{0,3})\.[0-9]")


class PlanChange(NamedTuple):
    """Ticks ``start`` <= t < ``end`` of one track in which plans differ; None where a plan has no track."""

    group: Group
    start: int
    end: int
    before: str | None
    after: str | None


def plan_changes(before: Plan, after: Plan) -> list[PlanChange]:
    """Where ``after`` says something else than ``before``, track by track, as long stretches as possible."""
    changes: list[PlanChange] = []
    for group in GROUPS:
        pairs = [(before.word_at(group, tick), after.word_at(group, tick)) for tick in range(TICKS)]
        ends = [*(tick for tick in range(1, TICKS) if pairs[tick] != pairs[tick - 1]), TICKS]
        for start, end in pairwise([0, *ends]):
            one, other = pairs[start]
            if one != other:
                changes.append(PlanChange(group, start, end, one, other))
    return changes


def parse_plan(text: str, first_line: int = 1) -> Plan:
    """Read the bullet text strictly.

    Args:
        text: the bullet list, a final line break may be missing.
        first_line: the number of its first line, for errors about a larger text.

    Raises:
        PlanError: with line and column: gap, overlap, unknown word or group, groups out of order or twice,
            times outside 0.0-6.4 s or off the 0.1 s grid, anything that is not a bullet of the language.
    """
    tracks: dict[Group, list[MetaAction]] = {}
    group: Group | None = None
    lines = text.removesuffix("\n").split("\n")
    for number, line in enumerate(lines, start=first_line):
        if found := _GROUP_LINE.fullmatch(line):
            if group is not None:
                _close(group, tracks[group], number - 1, lines[number - 1 - first_line])
            group = _next_group(found["group"], group, number)
            tracks[group] = []
        elif found := _SEGMENT_LINE.fullmatch(line):
            if group is None:
                raise PlanError("a meta-action before any group", number, 1)
            tracks[group].append(_segment(found, group, tracks[group], number))
        else:
            raise PlanError(
                "expected '- group' or '  - 0.0s-0.9s: Word', "
                + (f"found {line!r}" if line else "found an empty line"),
                number,
                1,
            )
    if group is not None:
        _close(group, tracks[group], first_line + len(lines) - 1, lines[-1])
    return Plan(**{name: tuple(actions) for name, actions in tracks.items()})


def _next_group(name: str, previous: Group | None, line: int) -> Group:
    for position, group in enumerate(GROUPS):
        if group == name:
            if previous is not None and position <= GROUPS.index(previous):
                raise PlanError(f"group {name} after {previous}: the order is {', '.join(GROUPS)}", line, 3)
            return group
    raise PlanError(f"unknown group {name!r}; known are {', '.join(GROUPS)}", line, 3)


def _segment(found: re.Match[str], group: Group, before: Sequence[MetaAction], line: int) -> MetaAction:
    ticks = []
    for part in ("start", "end"):
        if not _TIME.fullmatch(found[part]):
            raise PlanError(
                f"{found[part]!r} is not a time on the 0.1 s grid like 0.9", line, found.start(part) + 1
            )
        whole, tenth = found[part].split(".")
        ticks.append(10 * int(whole) + int(tenth))
    action = MetaAction(ticks[0], ticks[1], found["word"])
    try:
        _check_segment(group, action, before[-1].end if before else 0)
    except PlanError as error:
        column = found.start("word") if "unknown" in error.message else found.start("start")
        raise PlanError(error.message, line, column + 1) from None
    return action


def _close(group: Group, actions: Sequence[MetaAction], line: int, text: str) -> None:
    try:
        check_track(group, tuple(actions))
    except PlanError as error:
        raise PlanError(error.message, line, len(text) + 1) from None
