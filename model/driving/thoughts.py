"""Thoughts as facts, and the sentences that they are written in: ELF-VLA's chain of thought.

The order is that of ELF-VLA's prompt (supplement, figure 6): the road's boundaries, then only the agents that
may affect the ego, then what it does next. Agents are the three kinds of section 7.2: CIPO-1 leads in the own
lane, CIPO-2 merges from a lane beside, and others' ways cross the ego's. Static elements follow.

`looktwice.model.driving.sentences` holds the words.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal, cast

from looktwice.model.driving.high_level import HighLevelAction, Lateral, Longitudinal
from looktwice.model.driving.phrases import Side, State
from looktwice.model.driving.sentences import Meaning, joined, meanings_of, texts_of

Beside = Literal["none", "left", "right", "both"]
Origin = Literal["left", "right", "oncoming"]
Crosser = Literal["vehicle", "pedestrian"]
ObstacleKind = Literal["cone", "barrier", "pedestrian"]

_OTHER_SIDE: Final[Mapping[str, Side]] = {"left": "right", "right": "left"}


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
        return texts_of(self._meanings())

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


def read_thoughts(text: str) -> Thoughts:
    """The facts of a text, the inverse of ``str``; raises `ThoughtError`."""
    return _facts(iter(meanings_of(text)))


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
