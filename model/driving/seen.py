"""Cues in view: whether a scene shows what a reflection's facts say is to be seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from looktwice.model.driving.claims import CLEAR_WITHIN_M, is_near
from looktwice.model.driving.phrases import (
    FARTHEST_M,
    STEP_M,
    Bend,
    Clear,
    Cue,
    Facts,
    Junction,
    Room,
    Side,
    Spot,
    State,
    Straight,
    Thing,
)
from looktwice.model.driving.view import Place, Sight, View

STANDING_MS: Final = 0.5
"""Who is not faster stands."""
SLOWER_BY_MS: Final = 1.0
"""Who is slower by so much is called slower."""
LANES: Final[Mapping[Side, Place]] = {"left": "the left lane", "right": "the right lane"}
_TOLERANCE_MS: Final = 0.5
"""By which a judgement of speed may be wrong."""


def shown(cue: Cue, view: View) -> bool:
    """Whether a view shows a cue; distances and speeds may be told a little wrong."""
    match cue:
        case Thing(kind, place, ahead_m, state):
            return any(
                sight.kind == kind
                and (comes(sight) if place == "oncoming" else sight.place == place)
                and is_near(ahead_m, sight.ahead_m)
                and _moves(sight, state, view)
                for sight in view.sights
            )
        case Bend(side, estimated_m):
            return view.bend == side and is_near(estimated_m, view.bend_m)
        case Junction(side):
            return side in view.turns
        case Room(side):
            return side in view.beside and is_clear(view, LANES[side])
        case Straight():
            return view.bend is None
        case Clear():
            return is_clear(view, "my lane")


def all_shown(facts: Facts, view: View) -> bool | None:
    """Whether a view shows all cues of a reflection; None where it has none."""
    return all(shown(each.cue, view) for each in facts.statements) if facts.statements else None


def comes(sight: Sight) -> bool:
    """Whether it is a vehicle on its way towards the ego."""
    return sight.kind == "vehicle" and sight.speed_ms < -STANDING_MS


def is_clear(view: View, place: Place) -> bool:
    """Whether nobody is to be seen near in a lane."""
    return not any(sight.place == place and sight.ahead_m < CLEAR_WITHIN_M for sight in view.sights)


def estimated_m(metres: float) -> int:
    """A distance as one can estimate it, in steps of `STEP_M`."""
    return min(FARTHEST_M, STEP_M * round(metres / STEP_M))


def spot_of(sight: Sight) -> Spot:
    """Where it is, in the words of reflections."""
    return "oncoming" if comes(sight) else sight.place


def state_of(sight: Sight, view: View) -> State:
    """How a vehicle moves, where that is worth saying."""
    if sight.kind != "vehicle" or comes(sight):
        return ""
    if abs(sight.speed_ms) < STANDING_MS:
        return "standing"
    if sight.brakes:
        return "braking"
    return "slower" if sight.speed_ms < view.speed_ms - SLOWER_BY_MS else ""


def _moves(sight: Sight, state: State, view: View) -> bool:
    match state:
        case "standing":
            return abs(sight.speed_ms) < STANDING_MS + _TOLERANCE_MS
        case "slower":
            return sight.speed_ms < view.speed_ms - SLOWER_BY_MS + _TOLERANCE_MS
        case "braking":
            return sight.brakes
        case "":
            return True
