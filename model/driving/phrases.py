"""Reflections as facts, and the phrases that they are written in.

A reflection is up to three statements, one for each track of the plan that is to change: what is to be seen
(the cue), what would come of going on as planned, and what to do instead (the correction). Which consequences
a cue may have, and which corrections these, is a table, so that every reflection that can be written makes
sense. Each text below is one decision of the model that writes it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

from looktwice.model.driving.agents import AgentKind
from looktwice.model.driving.direction import Change, group_of, track_changes
from looktwice.model.driving.plan import GROUPS, Group, Plan

Side = Literal["left", "right"]
ReflectionLanguage = Literal["free_text", "phrases"]
"""What reflections are written in."""
State = Literal["", "standing", "slower", "braking"]
Spot = Literal["my lane", "the left lane", "the right lane", "the left side", "the right side", "oncoming"]
Consequence = Literal[
    "too close", "no time", "too fast", "stuck", "out of lane", "too cautious", "unnecessary", "wrong way"
]
Correction = Change | Literal["stop"]

STEP_M: Final = 5
"""Distances are told in such steps."""
FARTHEST_M: Final = 100
END: Final = "."
SPACE: Final = " "
GOING_ON: Final = " Going on like this"
NOTHING: Final = "My plan fits the road."
"""The reflection that asks for no change."""


class PhraseError(ValueError):
    """A text or facts that are no reflection in phrases; the text says why."""


@dataclass(frozen=True)
class Thing:
    """Somebody or something to be seen.

    Attributes:
        kind: what it is.
        place: where.
        ahead_m: how far, in steps of `STEP_M`; 0 for right ahead.
        state: how a vehicle moves; empty where that is not said.
    """

    kind: AgentKind
    place: Spot
    ahead_m: int
    state: State = ""


@dataclass(frozen=True)
class Bend:
    """The road bends to a side, ``ahead_m`` from here; None where that is not said."""

    side: Side
    ahead_m: int | None = None


@dataclass(frozen=True)
class Junction:
    """A lane leads off to a side."""

    side: Side


@dataclass(frozen=True)
class Room:
    """Nobody is in the lane beside."""

    side: Side


@dataclass(frozen=True)
class Straight:
    """The road does not bend."""


@dataclass(frozen=True)
class Clear:
    """Nobody is in the own lane."""


Cue = Thing | Bend | Junction | Room | Straight | Clear
Head = tuple[AgentKind, State] | Bend | Junction | Room | Straight | Clear
"""What a statement begins with: a cue but for places and distances."""

HEADS: Final[Mapping[str, Head]] = {
    "A vehicle": ("vehicle", ""),
    "A standing vehicle": ("vehicle", "standing"),
    "A slower vehicle": ("vehicle", "slower"),
    "A braking vehicle": ("vehicle", "braking"),
    "A pedestrian": ("pedestrian", ""),
    "A traffic cone": ("cone", ""),
    "A barrier": ("barrier", ""),
    "The road bends left": Bend("left"),
    "The road bends right": Bend("right"),
    "The road runs straight on": Straight(),
    "The junction lets me go left": Junction("left"),
    "The junction lets me go right": Junction("right"),
    "My lane is clear": Clear(),
    "There is room in the left lane": Room("left"),
    "There is room in the right lane": Room("right"),
}
_SPOTS: Final[Mapping[str, Spot]] = {
    " is in my lane": "my lane",
    " is in the left lane": "the left lane",
    " is in the right lane": "the right lane",
    " is on the left side": "the left side",
    " is on the right side": "the right side",
    " is oncoming": "oncoming",
}
_AHEAD: Final[Mapping[str, int]] = {
    " right ahead": 0,
    **{f" some {metres} metres ahead": metres for metres in range(STEP_M, FARTHEST_M + 1, STEP_M)},
}
_AHEAD_OF_BENDS: Final[Mapping[str, int | None]] = {
    "": None,
    **{text: metres for text, metres in _AHEAD.items() if metres},
}
CONSEQUENCES: Final[Mapping[str, Consequence]] = {
    " would bring me too close": "too close",
    " would leave no time to react": "no time",
    " would carry too much speed into the curve": "too fast",
    " would get me stuck": "stuck",
    " would carry me out of the lane": "out of lane",
    " would be needlessly cautious": "too cautious",
    " would be unnecessary": "unnecessary",
    " would miss the way": "wrong way",
}
CORRECTIONS: Final[Mapping[str, Correction]] = {
    ", so I should slow down sooner": "slower",
    ", so I should brake and stop": "stop",
    ", so I should pick up speed": "faster",
    ", so I should turn left": "left",
    ", so I should turn right": "right",
    ", so I should steer straight for longer": "straight",
    ", so I should move to the left lane": "lane_left",
    ", so I should move to the right lane": "lane_right",
    ", so I should stay in my lane": "keep_lane",
}
_OTHER_SIDE: Final[Mapping[Side, Side]] = {"left": "right", "right": "left"}
_OTHER_PLACE: Final[Mapping[Spot, Spot]] = {
    "the left lane": "the right lane",
    "the right lane": "the left lane",
    "the left side": "the right side",
    "the right side": "the left side",
}
_OTHER_WAY: Final[Mapping[Correction, Correction]] = {
    "left": "right",
    "right": "left",
    "lane_left": "lane_right",
    "lane_right": "lane_left",
}
_LANE_OF: Final[Mapping[Side, Correction]] = {"left": "lane_left", "right": "lane_right"}


def consequences(head: Head) -> dict[Consequence, tuple[Correction, ...]]:
    """What may come of going on as planned, and what may then be done instead."""
    match head:
        case Bend(side):
            return {"too fast": ("slower",), "out of lane": (side, "straight")}
        case Straight():
            return {"out of lane": ("straight",)}
        case Junction(side):
            return {"wrong way": (side,)}
        case Room(side):
            return {"stuck": (_LANE_OF[side],)}
        case Clear():
            return {"too cautious": ("faster",), "unnecessary": ("keep_lane",)}
        case _:
            return {
                "too close": ("slower", "stop", "keep_lane"),
                "no time": ("slower", "stop"),
                "stuck": ("lane_left", "lane_right"),
                "too cautious": ("faster",),
                "unnecessary": ("keep_lane",),
            }


def details(head: Head) -> tuple[tuple[str, ...], ...]:
    """The decisions behind a head, up to the end of its sentence: the texts that each is between."""
    match head:
        case (_, _):
            comes = head == ("vehicle", "")
            spots = (text for text, spot in _SPOTS.items() if comes or spot != "oncoming")
            return (tuple(spots), tuple(_AHEAD))
        case Bend():
            return (tuple(_AHEAD_OF_BENDS),)
        case _:
            return ()


def change_of(correction: Correction) -> Change:
    """The change of a plan that a correction asks for."""
    return "slower" if correction == "stop" else correction


@dataclass(frozen=True)
class Statement:
    """Why a track is to change, and how; raises `PhraseError` for facts that do not go together."""

    cue: Cue
    consequence: Consequence
    correction: Correction

    def __post_init__(self) -> None:
        if self.correction not in consequences(head_of(self.cue)).get(self.consequence, ()):
            raise PhraseError(f"{self.cue} is no reason for {self.correction!r} ({self.consequence})")
        self.texts()

    @property
    def change(self) -> Change:
        """What the plan is to do more of."""
        return change_of(self.correction)

    def mirrored(self) -> Statement:
        """The same with left and right swapped."""
        correction = _OTHER_WAY.get(self.correction, self.correction)
        return Statement(_mirrored(self.cue), self.consequence, correction)

    def texts(self) -> tuple[str, ...]:
        """The texts of its decisions; raises `PhraseError` for a cue that there are no words for."""
        return (
            *_texts_of(self.cue),
            _text(CONSEQUENCES, self.consequence),
            _text(CORRECTIONS, self.correction),
        )

    def __str__(self) -> str:
        *cue, consequence, correction = self.texts()
        return "".join((*cue, END, GOING_ON, consequence, correction, END))


@dataclass(frozen=True)
class Facts:
    """A reflection; without statements nothing is to be changed.

    Raises:
        PhraseError: two statements on one track, or not in the order of a plan's tracks.
    """

    statements: tuple[Statement, ...] = ()

    def __post_init__(self) -> None:
        places = [GROUPS.index(group_of(each.change)) for each in self.statements]
        if places != sorted(set(places)):
            raise PhraseError(
                f"a reflection states one change of each track, in the order {', '.join(GROUPS)}"
            )

    def mirrored(self) -> Facts:
        """The same with left and right swapped."""
        return Facts(tuple(each.mirrored() for each in self.statements))

    @property
    def groups(self) -> frozenset[Group]:
        """The tracks that something is stated of."""
        return frozenset(group_of(change) for change in self.changes)

    @property
    def changes(self) -> tuple[Change, ...]:
        """The changes that are asked for, at most one of each track."""
        return tuple(each.change for each in self.statements)

    def __str__(self) -> str:
        return SPACE.join(map(str, self.statements)) or NOTHING


def read_facts(text: str) -> Facts:
    """The facts of a reflection, the inverse of ``str``; raises `PhraseError`."""
    if text == NOTHING:
        return Facts()
    statements, place = list[Statement](), 0
    while place < len(text) or not statements:
        found = _STATEMENT.match(text, place)
        if found is None:
            raise PhraseError(
                f"no statement in phrases at character {place + 1}: {text[place : place + 60]!r}"
            )
        cue = _cue(found["head"], found["spot"], found["ahead"] or "")
        statements.append(
            Statement(cue, CONSEQUENCES[found["consequence"]], CORRECTIONS[found["correction"]])
        )
        place = found.end()
        if place < len(text):
            place += text.startswith(SPACE, place)
    facts = Facts(tuple(statements))
    if str(facts) != text:
        raise PhraseError("what is between two statements is one space, and nothing is behind the last")
    return facts


def facts_of(text: str) -> Facts | None:
    """The facts of a reflection; None where it is free text."""
    try:
        return read_facts(text)
    except PhraseError:
        return None


def unfinished(text: str) -> str:
    """What is written behind the whole statements that a text begins with."""
    place = 0
    while found := _STATEMENT.match(text, place):
        place = found.end()
        place += text.startswith(SPACE, place)
    return text[place:]


def agrees(facts: Facts, before: Plan, after: Plan) -> bool:
    """Whether a plan changes in the directions that are stated, and in no other.

    A track that one of the plans does not tell, and that nothing is stated of, does not count.
    """
    stated = {group_of(change): change for change in facts.changes}
    for group in GROUPS:
        changes = track_changes(before, after, group)
        if group in stated and stated[group] not in changes:
            return False
        told = before.track(group) is not None and after.track(group) is not None
        if group not in stated and told and changes:
            return False
    return True


def corrected(before: Plan, better: Plan, facts: Facts) -> Plan:
    """The plan that a reflection leads to: tracks that something is stated of are those of ``better``."""
    return Plan(**{group: (better if group in facts.groups else before).track(group) for group in GROUPS})


def head_of(cue: Cue) -> Head:
    """What a statement with a cue begins with."""
    match cue:
        case Thing(kind, _, _, state):
            return (kind, state)
        case Bend(side):
            return Bend(side)
        case _:
            return cue


def _mirrored(cue: Cue) -> Cue:
    match cue:
        case Thing(place=place):
            return replace(cue, place=_OTHER_PLACE.get(place, place))
        case Bend(side) | Junction(side) | Room(side):
            return replace(cue, side=_OTHER_SIDE[side])
        case _:
            return cue


def _texts_of(cue: Cue) -> tuple[str, ...]:
    head = head_of(cue)
    texts = [_text(HEADS, head)]
    if isinstance(cue, Thing):
        texts += [_text(_SPOTS, cue.place), _text(_AHEAD, cue.ahead_m)]
    elif isinstance(cue, Bend):
        texts.append(_text(_AHEAD_OF_BENDS, cue.ahead_m))
    for text, possible in zip(texts[1:], details(head), strict=True):
        if text not in possible:
            raise PhraseError(f"there are no words for {cue}")
    return tuple(texts)


def _cue(head: str, spot: str | None, ahead: str) -> Cue:
    match HEADS[head]:
        case (kind, state):
            if spot is None or ahead not in _AHEAD:
                raise PhraseError(f"{head!r} needs a place and a distance")
            return Thing(kind, _SPOTS[spot], _AHEAD[ahead], state)
        case Bend(side) if spot is None and ahead in _AHEAD_OF_BENDS:
            return Bend(side, _AHEAD_OF_BENDS[ahead])
        case (Junction() | Room() | Straight() | Clear()) as cue if spot is None and not ahead:
            return cue
    raise PhraseError(f"{head!r} has no such place or distance")


def _text(texts: Mapping[str, object], meaning: object) -> str:
    found = next((text for text, each in texts.items() if each == meaning), None)
    if found is None:
        raise PhraseError(f"there are no words for {meaning!r}")
    return found


def _any(name: str, texts: Mapping[str, object]) -> str:
    # The longest first: a text may be the beginning of another.
    return f"(?P<{name}>{'|'.join(map(re.escape, sorted(texts, key=len, reverse=True)))})"


_STATEMENT: Final = re.compile(
    _any("head", HEADS)
    + f"{_any('spot', _SPOTS)}?{_any('ahead', _AHEAD)}?"
    + re.escape(END + GOING_ON)
    + _any("consequence", CONSEQUENCES)
    + _any("correction", CORRECTIONS)
    + re.escape(END)
)
