"""Cues that may be named: what is in view as far as a planner itself can know it.

A model must not speak of what it does not see. What it sees is what the scene tells as tracks, or else the
facts that its network reads from the pictures (`model.driving.facts`). Annotations play no part here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from model.driving.claims import CLEAR_WITHIN_M
from model.driving.facts import FACTS, ROAD_DISTANCES_M, ROAD_SCALE_M, SPEED_SCALE_MS
from model.driving.phrases import FARTHEST_M, STEP_M, Bend, Clear, Cue, Junction, Room, Straight, Thing
from model.driving.seen import LANES, is_clear, spot_of, state_of
from model.driving.tracks import Track
from model.driving.trajectory import FloatArray, present_speed
from model.driving.view import Sight, View, bend_of, view_along

Array = npt.NDArray[np.float64]

THERE: Final = 0.7
ABSENT: Final = 0.3
"""Something is so where it is read with at least the one probability, and is not with less than the other.

Chosen on validation scenes: of the leads that are told then, eight of ten are where they are said to be.
"""
SPEED_ERROR_MS: Final = 1.0
"""By which a speed that is read may be wrong: who is slower by less is not called slower."""
_LEAST_AHEAD_M: Final = 1.0
_INDEX: Final = {name: index for index, name in enumerate(FACTS)}


def cues_tracked(history: FloatArray, route: FloatArray | None, tracks: Sequence[Track]) -> frozenset[Cue]:
    """What may be said of a scene whose tracks are known; see `model.driving.view.view_along`."""
    return cues_in(view_along(history, route, tracks))


def cues_read(history: FloatArray, route: FloatArray | None, facts: FloatArray) -> frozenset[Cue]:
    """What may be said of a scene by the facts that are read from its pictures.

    Of others only who is ahead in the own lane: the facts of other lanes and of walkers are not read well
    enough to be named.

    Args:
        history: float32 [16, 4].
        route: float32 [20, 2]; where there is none, the facts tell how the road runs.
        facts: float32 [len(FACTS)], with probabilities for what is or is not so.
    """
    told = {name: float(facts[index]) for name, index in _INDEX.items()}
    sights: tuple[Sight, ...] = ()
    if told["own_0_present"] >= THERE > told["own_0_fixed"]:
        standing = told["own_0_standing"] >= THERE
        speed_ms = 0.0 if standing else SPEED_SCALE_MS * told["own_0_speed"] + SPEED_ERROR_MS
        gap_m = max(0.0, math.expm1(told["own_0_gap_log_m"]))
        sights = (Sight("vehicle", gap_m, "my lane", speed_ms, told["own_0_braking"] >= THERE),)
    bend, bend_m = bend_of(_road(told) if route is None else route)
    cues = cues_in(View(present_speed(history), sights, bend, bend_m))
    return cues - {Clear()} if told["own_0_present"] >= ABSENT and not sights else cues


def cues_in(view: View) -> frozenset[Cue]:
    """What may be said of a view: what `model.driving.seen.shown` finds in it, told as it is.

    What is beside the own lane matters to a plan up to where that lane would count as clear; farther things
    are not named.
    """
    cues = set[Cue]()
    for sight in view.sights:
        within_m = FARTHEST_M if sight.place == "my lane" else CLEAR_WITHIN_M
        if (ahead_m := STEP_M * round(sight.ahead_m / STEP_M)) <= within_m:
            states = {"", state_of(sight, view)}
            cues |= {Thing(sight.kind, spot_of(sight), ahead_m, state) for state in states}
    if view.bend is None:
        cues.add(Straight())
    else:
        bend_m = STEP_M * round(view.bend_m / STEP_M)
        cues |= {Bend(view.bend, told_m) for told_m in {None, bend_m or None}}
    cues |= {Junction(side) for side in view.turns}
    cues |= {Room(side) for side in view.beside if is_clear(view, LANES[side])}
    if is_clear(view, "my lane"):
        cues.add(Clear())
    return frozenset(cues)


def _road(told: Mapping[str, float]) -> Array:
    """The road ahead, [k, 2], of how far it is to the left at given distances along it."""
    left_m = np.array([ROAD_SCALE_M * told[f"road_left_{distance}m"] for distance in ROAD_DISTANCES_M])
    along_m, aside_m = np.diff(ROAD_DISTANCES_M, prepend=0), np.diff(left_m, prepend=0.0)
    ahead_m = np.sqrt(np.maximum(along_m**2 - aside_m**2, _LEAST_AHEAD_M**2))
    return np.stack([np.cumsum(ahead_m), left_m], axis=1)
