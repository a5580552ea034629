"""Reading plans out of teachers' text: what is unambiguous is mended, and every mend is reported."""

from __future__ import annotations

import re
from collections.abc import Sequence
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
    Track,
    format_tick,
    track_from_words,
)


@dataclass(frozen=True)
class MendedPlan:
    """A plan read leniently, and what had to be mended in its text."""

    plan: Plan
    mends: tuple[str, ...]


_LENIENT_GROUP: Final = re.compile(r"[\s*#\-]*(longitudinal|lateral|lane)\b[\s:*]*", re.IGNORECASE)
_LENIENT_TIME: Final = r"([0-9]{1,3}(?:\.[0-9]{1,6})?)\s*s?"
_LENIENT_SEGMENT: Final = re.compile(
    # A bullet, two times with a hyphen, a dash or "to" between, a word; full stops and asterisks are trimmed.
    rf"[\s*\-\u2022]*{_LENIENT_TIME}\s*(?:-|\u2013|\u2014|to)\s*{_LENIENT_TIME}\s*:\s*(.+?)[\s.*]*",
    re.IGNORECASE,
)


def parse_plan_leniently(text: str) -> MendedPlan:
    """Read a teacher's text, mend what is unambiguous and report every mend.

    Mended: bullets, indentation, letter case, times off the grid (rounded), gaps (the segment before is
    stretched), overlaps (the later segment yields), ends short of or beyond 6.4 s, lines that are no bullets.

    Raises:
        PlanError: where no reading is unambiguous: no group at all, an unknown word.
    """
    mends: list[str] = []
    tracks: dict[Group, list[MetaAction]] = {}
    group: Group | None = None
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip():
            continue
        if found := _LENIENT_GROUP.fullmatch(line):
            named: Group = next(name for name in GROUPS if name == found[1].lower())
            group = named
            if group in tracks:
                mends.append(f"line {number}: group {group} again, the later one counts")
            tracks[group] = []
            if line != f"- {group}":
                mends.append(f"line {number}: group line rewritten")
        elif (found := _LENIENT_SEGMENT.fullmatch(line)) and group is not None:
            action = _lenient_segment(found, group, number)
            if action.end <= action.start:
                mends.append(f"line {number}: left out, {action} does not end after it starts")
                continue
            if line != f"  - {action}":
                mends.append(f"line {number}: rewritten as '{action}'")
            tracks[group].append(action)
        else:
            mends.append(f"line {number}: left out, not a meta-action")
    plan = Plan(**{name: _mend_track(name, actions, mends) for name, actions in tracks.items() if actions})
    if not plan.tracks():
        raise PlanError("no meta-actions found")
    if list(tracks) != [name for name in GROUPS if name in tracks]:
        mends.append("groups put in order")
    return MendedPlan(plan, tuple(mends))


def _lenient_segment(found: re.Match[str], group: Group, line: int) -> MetaAction:
    for word in WORDS[group]:
        if word.lower() == " ".join(found[3].lower().split()):
            return MetaAction(round(10 * float(found[1])), round(10 * float(found[2])), word)
    raise PlanError(
        f"unknown {group} word {found[3]!r}; known are {', '.join(WORDS[group])}", line, found.start(3) + 1
    )


def _mend_track(group: Group, actions: Sequence[MetaAction], mends: list[str]) -> Track:
    words: list[str | None] = [None] * TICKS
    for action in sorted(actions, key=lambda action: action.start):
        if action.end > TICKS:
            mends.append(f"{group}: {action} cut at {format_tick(TICKS)}s")
        for tick in range(max(action.start, 0), min(action.end, TICKS)):
            if words[tick] is None:
                words[tick] = action.word
            elif words[tick] != action.word:
                mends.append(f"{group}: {action} yields where it overlaps")
                break
        for tick in range(max(action.start, 0), min(action.end, TICKS)):
            words[tick] = words[tick] or action.word
    known = [word for word in words if word is not None]
    if not known:
        raise PlanError(f"group {group} has no meta-action within 0.0s-{format_tick(TICKS)}s")
    if len(known) < TICKS:
        mends.append(f"{group}: gaps closed")
    filled: list[str] = []
    for word in words:
        filled.append(word or (filled[-1] if filled else known[0]))
    return track_from_words(filled)
