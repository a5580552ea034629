"""What a reasoning says is to be seen on the road, and whether a scene's view shows it.

Words are read as far as rules can: who is named, in which lane, how far ahead, which lane is clear, which way
the road bends. What a text only asks for ("I should move left") or fears ("this would …") is no claim.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Literal

from looktwice.model.driving.agents import AgentKind
from looktwice.model.driving.direction import CORRECTION
from looktwice.model.driving.view import Bend, Place, View

CLEAR_WITHIN_M: Final = 45.0
"""A lane is clear where nobody is to be seen in it nearer than this."""
DISTANCE_ERROR_M: Final = 5.0
DISTANCE_ERROR: Final = 0.25
"""A distance may be told wrong by so many metres, or by this share of it where that is more."""
RIGHT_AHEAD_M: Final = 5.0
"""What "right ahead" stands for."""

_ANYWHERE: Final[frozenset[Place]] = frozenset(
    ("my lane", "the left lane", "the right lane", "the left side", "the right side")
)
_KINDS: Final[dict[AgentKind, str]] = {
    "vehicle": r"vehicles?|cars?|vans?|trucks?|bus(?:es)?|motor(?:cycl|bik)\w+|cyclists?|bicycles?",
    "pedestrian": r"pedestrians?|persons?|people|walkers?|child(?:ren)?|workers?",
    "cone": r"cones?",
    "barrier": r"barriers?",
}
_NOUNS: Final = re.compile("|".join(rf"\b(?P<{kind}>{words})\b" for kind, words in _KINDS.items()))
_PLACES: Final[tuple[tuple[re.Pattern[str], frozenset[Place]], ...]] = (
    (re.compile(r"\bleft lane\b|\blane (?:to|on) (?:the|my) left\b"), frozenset({"the left lane"})),
    (re.compile(r"\bright lane\b|\blane (?:to|on) (?:the|my) right\b"), frozenset({"the right lane"})),
    (re.compile(r"\b(?:my|our|the own|ego) lane\b|\bin front of me\b"), frozenset({"my lane"})),
    (
        re.compile(r"\bleft side\b|\b(?:on|to) (?:the|my) left\b"),
        frozenset({"the left side", "the left lane"}),
    ),
    (
        re.compile(r"\bright side\b|\b(?:on|to) (?:the|my) right\b"),
        frozenset({"the right side", "the right lane"}),
    ),
)
_METRES: Final = re.compile(r"\b(\d+(?:\.\d+)?) ?(?:m|met(?:re|er)s?)\b")
_RIGHT_AHEAD: Final = re.compile(r"\b(?:right|directly|just|straight) (?:ahead|in front)\b")
_NONE: Final = re.compile(r"\b(?:no|without|nor)(?: \w+)? $")
_CLEAR: Final = re.compile(
    r"\b(?:my|our) lane is (?:clear|free|open|empty)|\bnothing (?:is )?in (?:my|our) lane|"
    r"\b(?:road|way) ahead(?: in (?:my|our) lane)? is (?:clear|free|open|empty)"
)
_ROOM: Final = re.compile(
    r"\b(?:room|space) in the (left|right) lane|"
    r"\blane to the (left|right) of mine is (?:clear|free|open|empty)|"
    r"\bthe (left|right) lane is (?:clear|free|open|empty)"
)
_BENDS: Final = re.compile(
    r"\b(?:road|lane|way)s? (?:bend|curve|turn)s? (?:to the )?(left|right)|\b(left|right) (?:bend|curve)\b"
)
_BRANCHES: Final = re.compile(r"\blets me (?:go|turn) (left|right)|\blane leads (left|right)\b")
_CURVE: Final = re.compile(r"\b(?:curve|bend) (?:begins|starts|is)\b")
_STRAIGHT: Final = re.compile(r"\b(?:lane|road|markings?) runs? straight (?:on|ahead)\b")
_SENTENCES: Final = re.compile(r"(?<=[.;!?])\s+")
_NOT_SEEN: Final = re.compile(r"\b(?:if|would|could|might|may|risks?)\b")
_HENCE: Final = re.compile(r",? (?:so|therefore|thus|instead)\b(?! far)")

Subject = Literal["object", "clear", "road"]


@dataclass(frozen=True)
class Claim:
    """One thing that a text says is to be seen.

    Attributes:
        subject: somebody or something, a lane without them, or how the road runs.
        words: of the text.
        holds: whether a view shows it.
    """

    subject: Subject
    words: str
    holds: Callable[[View], bool]


def claims(text: str) -> list[Claim]:
    """What a text says is to be seen, in its order; empty where it speaks of nothing that can be checked."""
    plain = " ".join(text.casefold().replace("-", " ").split())
    return [claim for sentence in _SENTENCES.split(plain) for claim in _of(_seen(sentence))]


def unfounded(text: str, view: View) -> list[Claim]:
    """The claims of a text that a view does not show."""
    return [claim for claim in claims(text) if not claim.holds(view)]


def _seen(sentence: str) -> str:
    """A sentence up to what it asks for or fears."""
    ends = [found.start() for found in (CORRECTION.search(sentence), _HENCE.search(sentence)) if found]
    if feared := _NOT_SEEN.search(sentence):
        # Who fears has named the subject before: "accelerating would", not "a car ahead would".
        ends.append(sentence.rfind(",", 0, feared.start()) if "," in sentence[: feared.start()] else 0)
    return sentence[: min(ends)] if ends else sentence


def _of(seen: str) -> Iterator[Claim]:
    yield from _roads(seen)
    if _CLEAR.search(seen):
        yield Claim("clear", seen, lambda view: not _anybody(view, frozenset({"my lane"})))
    if found := _ROOM.search(seen):
        side = _side(found)
        yield Claim("clear", seen, lambda view: side in view.beside and not _anybody(view, _lane(side)))
    nouns = list(_NOUNS.finditer(seen))
    for noun, then in zip(nouns, [*nouns[1:], None], strict=False):  # without nouns there is one None
        behind = seen[noun.end() : then.start() if then else len(seen)]
        before = seen[: noun.start()] if noun is nouns[0] else ""
        yield _object(_kind(noun), noun.group(), before, behind, negated=bool(_NONE.search(before)))


def _object(kind: AgentKind, words: str, before: str, behind: str, *, negated: bool) -> Claim:
    places = _places(behind) or _places(before) or _ANYWHERE
    told_m = _distance(behind)

    def is_there(view: View) -> bool:
        return any(
            sight.kind == kind and sight.place in places and is_near(told_m, sight.ahead_m)
            for sight in view.sights
        )

    def is_not_there(view: View) -> bool:
        lanes: frozenset[Place] = frozenset({"my lane"}) if places == _ANYWHERE else places
        return not any(
            sight.kind == kind and sight.place in lanes and sight.ahead_m < CLEAR_WITHIN_M
            for sight in view.sights
        )

    return Claim("object", f"{words}{behind}".strip(), is_not_there if negated else is_there)


def _roads(seen: str) -> Iterator[Claim]:
    told_m = _distance(seen)
    if bends := _BENDS.search(seen):
        side = _side(bends)
        yield Claim("road", seen, lambda view: view.bend == side and is_near(told_m, view.bend_m))
    elif branches := _BRANCHES.search(seen):
        way = _side(branches)
        yield Claim("road", seen, lambda view: way in view.turns)
    elif _CURVE.search(seen):
        yield Claim("road", seen, lambda view: view.bend is not None and is_near(told_m, view.bend_m))
    elif _STRAIGHT.search(seen):
        yield Claim("road", seen, lambda view: view.bend is None)


def _kind(noun: re.Match[str]) -> AgentKind:
    return next(kind for kind in _KINDS if noun[kind] is not None)


def _side(found: re.Match[str]) -> Bend:
    return "left" if "left" in found.groups() else "right"


def _lane(side: Bend) -> frozenset[Place]:
    return frozenset({"the left lane"}) if side == "left" else frozenset({"the right lane"})


def _places(words: str) -> frozenset[Place]:
    return next((places for pattern, places in _PLACES if pattern.search(words)), frozenset())


def _distance(words: str) -> float | None:
    if found := _METRES.search(words):
        return float(found[1])
    return RIGHT_AHEAD_M if _RIGHT_AHEAD.search(words) else None


def is_near(told_m: float | None, true_m: float) -> bool:
    """Whether a distance is told well enough; always where none is told."""
    return told_m is None or abs(told_m - true_m) <= max(DISTANCE_ERROR_M, DISTANCE_ERROR * true_m)


def _anybody(view: View, places: frozenset[Place]) -> bool:
    return any(sight.place in places and sight.ahead_m < CLEAR_WITHIN_M for sight in view.sights)
