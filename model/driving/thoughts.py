"""Thoughts as facts, and the sentences that they are written in: ELF-VLA's chain of thought.

The order is that of ELF-VLA's prompt (supplement, figure 6): the road's boundaries, then only the agents that
may affect the ego, then what it does next. Agents are the three kinds of section 7.2: CIPO-1 leads in the own
lane, CIPO-2 merges from a lane beside, and others' ways cross the ego's. Static elements follow.

Every text in the tables below is one decision of the model that writes it. So each text is read as facts
again, and what cannot be written cannot be stated either.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal, cast

from model.driving.high_level import HighLevelAction, Lateral, Longitudinal
from model.driving.phrases import FARTHEST_M, STEP_M, Side, State

EDGE_STEP_M: Final = 0.5
EDGE_FARTHEST_M: Final = 3.0
"""Road edges are told in such steps up to there: a lane's width farther away, nobody steers by them."""

Beside = Literal["none", "left", "right", "both"]
Origin = Literal["left", "right", "oncoming"]
Crosser = Literal["vehicle", "pedestrian"]
ObstacleKind = Literal["cone", "barrier", "pedestrian"]
Meaning = str | int | float | bool | None

_OTHER_SIDE: Final[Mapping[str, Side]] = {"left": "right", "right": "left"}


class ThoughtError(ValueError):
    """A text that does not tell thoughts, or facts that there are no words for; the text says why."""


@dataclass(frozen=True)
class Edges:
    """From the ego's sides to the edges of the road, in steps of `EDGE_STEP_M`.

    None is farther than `EDGE_FARTHEST_M`. Where the ego is off the road, both are 0.
    """

    left_m: float | None
    right_m: float | None


@dataclass(frozen=True)
class Leader:
    """CIPO-1: the nearest vehicle ahead in the own lane, ``ahead_m`` from bumper to bumper."""

    state: State
    ahead_m: int


@dataclass(frozen=True)
class Merging:
    """CIPO-2: a vehicle that is about to come into the own lane; 0 m ahead is beside the ego."""

    side: Side
    ahead_m: int


@dataclass(frozen=True)
class Crossing:
    """Motion interaction: somebody whose way crosses the ego's.

    Attributes:
        kind: who.
        origin: the side that they come from, or oncoming in the ego's lane.
        ahead_m: where the ways cross.
        first: whether they are there before the ego.
    """

    kind: Crosser
    origin: Origin
    ahead_m: int
    first: bool


@dataclass(frozen=True)
class Obstacle:
    """Something that does not move in the own lane."""

    kind: ObstacleKind
    ahead_m: int


@dataclass(frozen=True)
class Road:
    """How the own lane runs, and on which sides there is another lane of the same way.

    Attributes:
        bend: the side that it bends to within reach; None where it runs straight on.
        bend_m: where it begins to; None exactly where it does not.
    """

    bend: Side | None = None
    bend_m: int | None = None
    beside: Beside = "none"


@dataclass(frozen=True)
class Thoughts:
    """What leads to what the ego does next; raises `ThoughtError` for facts that there are no words for.

    Attributes:
        edges: of the road.
        leader, merging, crossing: the agents that may affect the ego, at most one of each kind.
        road, obstacle: static elements.
        action: what the ego does next.
    """

    edges: Edges
    leader: Leader | None
    merging: Merging | None
    crossing: Crossing | None
    road: Road
    obstacle: Obstacle | None
    action: HighLevelAction

    def __post_init__(self) -> None:
        self.texts()

    def mirrored(self) -> Thoughts:
        """The same with left and right swapped."""
        merging, crossing, road = self.merging, self.crossing, self.road
        if merging is not None:
            merging = replace(merging, side=_OTHER_SIDE[merging.side])
        if crossing is not None:
            origin = cast("Origin", _OTHER_SIDE.get(crossing.origin, crossing.origin))
            crossing = replace(crossing, origin=origin)
        bend = None if road.bend is None else _OTHER_SIDE[road.bend]
        beside = cast("Beside", _OTHER_SIDE.get(road.beside, road.beside))
        return replace(
            self,
            edges=Edges(self.edges.right_m, self.edges.left_m),
            merging=merging,
            crossing=crossing,
            road=replace(road, bend=bend, beside=beside),
            action=self.action.mirrored(),
        )

    def texts(self) -> tuple[str, ...]:
        """The texts of its decisions."""
        meanings = self._meanings()
        texts = [
            text for sentence in SENTENCES for words in sentence.words for text in _written(words, meanings)
        ]
        if rest := list(meanings):
            raise ThoughtError(f"there are no words for {rest[0]!r} in {self}")
        return tuple(texts)

    def __str__(self) -> str:
        return joined(self.texts())

    def _meanings(self) -> Iterator[Meaning]:
        yield from (self.edges.left_m, self.edges.right_m)
        leader, merging, crossing = self.leader, self.merging, self.crossing
        yield from (None,) if leader is None else (leader.state, leader.ahead_m)
        yield from (None,) if merging is None else (merging.side, merging.ahead_m)
        yield from (
            (None,)
            if crossing is None
            else (crossing.kind, crossing.origin, crossing.ahead_m, crossing.first)
        )
        road, obstacle = self.road, self.obstacle
        yield from (None,) if road.bend is None and road.bend_m is None else (road.bend, road.bend_m)
        yield road.beside
        yield from (None,) if obstacle is None else (obstacle.kind, obstacle.ahead_m)
        yield from (self.action.longitudinal, self.action.lateral)


@dataclass(frozen=True)
class Word:
    """What a text means, and the tables of what follows it."""

    meaning: Meaning
    then: tuple[Words, ...] = ()


Words = dict[str, Word]
"""The texts that a decision is between."""


@dataclass(frozen=True)
class Sentence:
    """What a sentence begins with, and its decisions."""

    start: str
    words: tuple[Words, ...] = field(repr=False)


END: Final = "."
SPACE: Final = " "


def _words(meanings: Mapping[str, Meaning], *then: Words) -> Words:
    return {text: Word(meaning, then) for text, meaning in meanings.items()}


def _edge(side: str) -> Words:
    steps = [EDGE_STEP_M * step for step in range(round(EDGE_FARTHEST_M / EDGE_STEP_M) + 1)]
    return _words({**{f"{side}{metres:.1f} m": metres for metres in steps}, f"{side}far": None})


def _ahead(end: str, at_once: str) -> Words:
    return _words(
        {at_once: 0, **{f" {metres} m{end}": metres for metres in range(STEP_M, FARTHEST_M + 1, STEP_M)}}
    )


_AHEAD: Final = _ahead(" ahead", " right ahead")
_ORIGINS: Final = _words({" from the left": "left", " from the right": "right", " oncoming": "oncoming"})
_SIDES: Final = _words({" from the left": "left", " from the right": "right"}, _ahead(" ahead", " beside me"))
_ORDER: Final = _words({", before me": True, ", after me": False})
_NOBODY: Final = _words({" nobody": None})
_STATES: Final[Mapping[str, Meaning]] = {
    " a vehicle": "",
    " a standing vehicle": "standing",
    " a slower vehicle": "slower",
    " a braking vehicle": "braking",
}
_BESIDE: Final[Mapping[str, Meaning]] = {
    ", no lane beside": "none",
    ", a lane on the left": "left",
    ", a lane on the right": "right",
    ", lanes on both sides": "both",
}
_LATERAL: Final[Mapping[Lateral, str]] = {
    "keep": " and keep the lane",
    "turn left": " and turn left",
    "turn right": " and turn right",
    "change left": " and change to the left lane",
    "change right": " and change to the right lane",
}
_LONGITUDINAL: Final[Mapping[Longitudinal, str]] = {
    "accelerate": " accelerate",
    "decelerate": " decelerate",
    "maintain": " maintain the speed",
    "stop": " stop",
}

SENTENCES: Final = (
    Sentence("Road edges:", (_edge(" left "), _edge(", right "))),
    Sentence("In my lane:", (_NOBODY | _words(_STATES, _AHEAD),)),
    Sentence("Merging:", (_NOBODY | _SIDES,)),
    Sentence(
        "Crossing:",
        (
            _NOBODY
            | _words({" a vehicle": "vehicle", " a pedestrian": "pedestrian"}, _ORIGINS, _AHEAD, _ORDER),
        ),
    ),
    Sentence(
        "Road:",
        (
            _words({" straight": None})
            | _words({" bends left": "left", " bends right": "right"}, _ahead(" ahead", " here")),
            _words(_BESIDE),
            _words({", nothing in the way": None})
            | _words({f", a {kind} in the way": kind for kind in ("cone", "barrier", "pedestrian")}, _AHEAD),
        ),
    ),
    Sentence(
        "Next:",
        (
            _words({text: each for each, text in _LONGITUDINAL.items()}),
            _words({text: each for each, text in _LATERAL.items()}),
        ),
    ),
)
"""Thoughts are all of these sentences, in this order."""


def joined(texts: tuple[str, ...]) -> str:
    """The text whose decisions are ``texts``; raises `ThoughtError` for any others."""
    left = iter(texts)
    written = [
        sentence.start + "".join(each for words in sentence.words for each in _taken(words, left)) + END
        for sentence in SENTENCES
    ]
    if rest := list(left):
        raise ThoughtError(f"nothing may follow the last sentence, as does {rest[0]!r}")
    return SPACE.join(written)


def decisions(text: str) -> tuple[str, ...]:
    """The texts of the decisions of a text, the inverse of `joined`; raises `ThoughtError`."""
    reader, found = _Reader(text), list[str]()
    for number, sentence in enumerate(SENTENCES):
        reader.expect((SPACE if number else "") + sentence.start)
        for words in sentence.words:
            found += reader.decisions(words)
        reader.expect(END)
    if rest := text[reader.place :]:
        raise ThoughtError(f"nothing may follow the last sentence, as does {rest[:40]!r}")
    return tuple(found)


def read_thoughts(text: str) -> Thoughts:
    """The facts of a text, the inverse of ``str``; raises `ThoughtError`."""
    left = iter(decisions(text))
    meanings = [
        meaning for sentence in SENTENCES for words in sentence.words for meaning in _meant(words, left)
    ]
    return _facts(iter(meanings))


def _facts(told: Iterator[Meaning]) -> Thoughts:
    # What a table holds decides what comes; the casts say what that is.
    edges = Edges(cast("float | None", next(told)), cast("float | None", next(told)))
    state = cast("State | None", next(told))
    leader = None if state is None else Leader(state, cast("int", next(told)))
    side = cast("Side | None", next(told))
    merging = None if side is None else Merging(side, cast("int", next(told)))
    crosser, crossing = cast("Crosser | None", next(told)), None
    if crosser is not None:
        origin, ahead_m = cast("Origin", next(told)), cast("int", next(told))
        crossing = Crossing(crosser, origin, ahead_m, cast("bool", next(told)))
    bend = cast("Side | None", next(told))
    bend_m = None if bend is None else cast("int", next(told))
    road = Road(bend, bend_m, cast("Beside", next(told)))
    kind = cast("ObstacleKind | None", next(told))
    obstacle = None if kind is None else Obstacle(kind, cast("int", next(told)))
    action = HighLevelAction(cast("Longitudinal", next(told)), cast("Lateral", next(told)))
    return Thoughts(edges, leader, merging, crossing, road, obstacle, action)


def _written(words: Words, meanings: Iterator[Meaning]) -> Iterator[str]:
    meant = next(meanings, "nothing")
    # 0 and False are equal, and so are 1.0 and True.
    found = [
        text for text, word in words.items() if word.meaning == meant and type(word.meaning) is type(meant)
    ]
    if not found:
        raise ThoughtError(f"there are no words for {meant!r}; there are some for {', '.join(words)}")
    yield found[0]
    for more in words[found[0]].then:
        yield from _written(more, meanings)


def _taken(words: Words, left: Iterator[str]) -> Iterator[str]:
    text = next(left, "")
    if text not in words:
        raise ThoughtError(f"expected one of {', '.join(map(repr, words))}, found {text!r}")
    yield text
    for more in words[text].then:
        yield from _taken(more, left)


def _meant(words: Words, left: Iterator[str]) -> Iterator[Meaning]:
    word = words[next(left)]
    yield word.meaning
    for more in word.then:
        yield from _meant(more, left)


class _Reader:
    def __init__(self, text: str) -> None:
        self._text, self.place = text, 0

    def expect(self, text: str) -> None:
        """Read ``text``."""
        if not self._text.startswith(text, self.place):
            raise self._error(repr(text))
        self.place += len(text)

    def decisions(self, words: Words) -> Iterator[str]:
        """Read a decision, and those that follow it."""
        # The longest first: a text may be the beginning of another.
        for text in sorted(words, key=len, reverse=True):
            if self._text.startswith(text, self.place):
                break
        else:
            raise self._error(f"one of {', '.join(map(repr, words))}")
        self.place += len(text)
        yield text
        for more in words[text].then:
            yield from self.decisions(more)

    def _error(self, expected: str) -> ThoughtError:
        seen = self._text[self.place : self.place + 40]
        return ThoughtError(f"character {self.place + 1}: expected {expected}, found {seen!r}")
