"""Reasons for changing a plan: which statements a view gives grounds for.

The built-in teacher explains by these rules what it knows to be better. A model that reflects may state only
what they allow of the view that it has itself: tracks, or the facts that its network reads from the pictures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.claims import CLEAR_WITHIN_M
from looktwice.model.driving.direction import CHANGES, Change
from looktwice.model.driving.facts import FACTS, ROAD_DISTANCES_M, ROAD_SCALE_M, SPEED_SCALE_MS
from looktwice.model.driving.phrases import (
    Bend,
    Clear,
    Consequence,
    Junction,
    Room,
    Side,
    Statement,
    Straight,
    Thing,
)
from looktwice.model.driving.seen import (
    LANES,
    SLOWER_BY_MS,
    STANDING_MS,
    estimated_m,
    is_clear,
    spot_of,
    state_of,
)
from looktwice.model.driving.tracks import Track
from looktwice.model.driving.trajectory import FloatArray, present_speed
from looktwice.model.driving.view import Place, Sight, View, bend_of, view_along

Array = npt.NDArray[np.float64]

THERE: Final = 0.7
ABSENT: Final = 0.3
"""What is read with at least the one probability is there, with less than the other it is not.

Chosen on validation scenes: of the leads that are told then, eight of ten are where they are said to be.
"""
SPEED_ERROR_MS: Final = 1.0
"""By which a speed that is read may be wrong: who is slower by less is not called slower."""
_CLOSE_M: Final = CLEAR_WITHIN_M
_NO_TIME_M: Final = {"pedestrian": 25.0, "vehicle": 12.0, "cone": 12.0, "barrier": 12.0}
"""Nearer than this there is no time to react."""
_WALKERS: Final[tuple[Place, ...]] = (
    *("my lane", "the left lane", "the right lane"),
    *("the left side", "the right side"),
)
_LEAST_AHEAD_M: Final = 1.0
_INDEX: Final = {name: index for index, name in enumerate(FACTS)}


def reason(change: Change, view: View, *, stops: bool, moves: Side) -> Statement | None:
    """What is to be seen that asks for a change; None where nothing is.

    Args:
        change: of the plan.
        view: what is to be seen.
        stops: whether slowing down ends in a standstill.
        moves: which way the plan leaves the lane that it is to keep.
    """
    match change:
        case "slower":
            return _slower(view, stops=stops)
        case "faster":
            return _faster(view)
        case "straight":
            cue = Straight() if view.bend is None else _bend(view.bend, view)
            return Statement(cue, "out of lane", change)
        case "left" | "right":
            if view.bend == change:
                return Statement(_bend(change, view), "out of lane", change)
            return Statement(Junction(change), "wrong way", change) if change in view.turns else None
        case "lane_left" | "lane_right":
            return _other_lane("left" if change == "lane_left" else "right", view)
        case "keep_lane":
            return _same_lane(view, moves)


def reasons_in(view: View) -> frozenset[Statement]:
    """All that a view gives a reason for."""
    found = (
        reason(change, view, stops=stops, moves=moves)
        for change in CHANGES
        for stops in (False, True)
        for moves in LANES
    )
    return frozenset(each for each in found if each is not None)


def reasons_tracked(
    history: FloatArray, route: FloatArray | None, tracks: Sequence[Track]
) -> frozenset[Statement]:
    """The reasons of a scene whose tracks are known; see `looktwice.model.driving.view.view_along`."""
    return reasons_in(view_along(history, route, tracks))


def reasons_read(history: FloatArray, route: FloatArray | None, facts: FloatArray) -> frozenset[Statement]:
    """The reasons of a scene by the facts that are read from its pictures.

    Of others only who is ahead in the own lane counts: the facts of other lanes and of walkers are not read
    well enough to be named. Whoever may be there keeps the lane from being clear, but is no reason.

    Args:
        history: float32 [16, 4].
        route: float32 [20, 2]; where there is none, the facts tell how the road runs.
        facts: float32 [len(FACTS)], with probabilities for what is or is not so.
    """
    told = {name: float(facts[index]) for name, index in _INDEX.items()}
    sights: tuple[Sight, ...] = ()
    if told["own_0_present"] >= ABSENT:
        standing = told["own_0_standing"] >= THERE
        speed_ms = 0.0 if standing else SPEED_SCALE_MS * told["own_0_speed"] + SPEED_ERROR_MS
        gap_m = max(0.0, math.expm1(told["own_0_gap_log_m"]))
        sights = (Sight("vehicle", gap_m, "my lane", speed_ms, told["own_0_braking"] >= THERE),)
    bend, bend_m = bend_of(_road(told) if route is None else route)
    reasons = reasons_in(View(present_speed(history), sights, bend, bend_m))
    if told["own_0_present"] >= THERE > told["own_0_fixed"]:
        return reasons
    return frozenset(each for each in reasons if not isinstance(each.cue, Thing))


def _slower(view: View, *, stops: bool) -> Statement | None:
    walker = view.first("pedestrian", places=_WALKERS)
    ahead = _ahead(view)
    beside = view.first("vehicle", "cone", "barrier", places=tuple(LANES.values()))
    if walker is not None and walker.ahead_m < _CLOSE_M:
        return _brake_for(walker, view, stops=stops)
    if ahead is None or not _holds_up(ahead, view):
        if view.bend is not None:
            return Statement(_bend(view.bend, view), "too fast", "slower")
        if ahead is None:
            ahead = beside if beside is not None and beside.ahead_m < _CLOSE_M else None
    return None if ahead is None else _brake_for(ahead, view, stops=stops)


def _brake_for(sight: Sight, view: View, *, stops: bool) -> Statement:
    consequence: Consequence = "no time" if sight.ahead_m < _NO_TIME_M[sight.kind] else "too close"
    return Statement(_thing(sight, view), consequence, "stop" if stops else "slower")


def _faster(view: View) -> Statement | None:
    if is_clear(view, "my lane"):
        return Statement(Clear(), "too cautious", "faster")
    ahead = view.first("vehicle", "cone", "barrier", "pedestrian", places=("my lane",))
    if ahead is None or not _leaves_room(ahead, view):
        return None
    return Statement(_thing(ahead, view), "too cautious", "faster")


def _same_lane(view: View, moves: Side) -> Statement | None:
    beside = view.first("vehicle", "cone", "barrier", places=(LANES[moves],))
    if beside is not None and beside.ahead_m < _CLOSE_M:
        return Statement(_thing(beside, view), "too close", "keep_lane")
    if is_clear(view, "my lane"):
        return Statement(Clear(), "unnecessary", "keep_lane")
    ahead = view.first("vehicle", "cone", "barrier", "pedestrian", places=("my lane",))
    if ahead is None or ahead.kind != "vehicle" or _holds_up(ahead, view):
        return None
    return Statement(_thing(ahead, view), "unnecessary", "keep_lane")


def _other_lane(side: Side, view: View) -> Statement | None:
    change: Change = "lane_left" if side == "left" else "lane_right"
    if (ahead := _ahead(view)) is not None:
        return Statement(_thing(ahead, view), "stuck", change)
    if side in view.beside and is_clear(view, LANES[side]):
        return Statement(Room(side), "stuck", change)
    return None


def _ahead(view: View) -> Sight | None:
    """The nearest thing that blocks the own lane."""
    return view.first("vehicle", "cone", "barrier", places=("my lane",))


def _leaves_room(sight: Sight, view: View) -> bool:
    """Whether one may pick up speed behind it: it drives, does not brake, and is far or drives off."""
    if sight.kind != "vehicle" or sight.speed_ms < STANDING_MS or sight.brakes:
        return False
    faster_ms = sight.speed_ms - view.speed_ms
    return faster_ms > SLOWER_BY_MS or (faster_ms > -SLOWER_BY_MS and sight.ahead_m > _NO_TIME_M[sight.kind])


def _holds_up(sight: Sight, view: View) -> bool:
    if sight.kind != "vehicle":
        return True
    return sight.ahead_m < _CLOSE_M and not sight.speed_ms > view.speed_ms + SLOWER_BY_MS


def _thing(sight: Sight, view: View) -> Thing:
    return Thing(sight.kind, spot_of(sight), estimated_m(sight.ahead_m), state_of(sight, view))


def _bend(side: Side, view: View) -> Bend:
    return Bend(side, estimated_m(view.bend_m) or None)


def _road(told: Mapping[str, float]) -> Array:
    """The road ahead, [k, 2], of how far it is to the left at given distances along it."""
    left_m = np.array([ROAD_SCALE_M * told[f"road_left_{distance}m"] for distance in ROAD_DISTANCES_M])
    along_m, aside_m = np.diff(ROAD_DISTANCES_M, prepend=0), np.diff(left_m, prepend=0.0)
    ahead_m = np.sqrt(np.maximum(along_m**2 - aside_m**2, _LEAST_AHEAD_M**2))
    return np.stack([np.cumsum(ahead_m), left_m], axis=1)
