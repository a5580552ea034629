"""Facts about a scene that decide how to drive, as numbers: targets for grounding the vision tower.

A vision-language model comes with such knowledge; a tower trained from scratch must learn it first. What
counts is who is ahead in each lane, how far and how fast, whether they stand or brake, what closes a lane,
who is about to cross, and where the road goes. Lanes are those of the route: the own one and its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.route_frame import RouteFrame
from looktwice.model.driving.scene import EGO_LENGTH_M, LabelledScene, Scene
from looktwice.model.driving.tracks import Track, tracks_of
from looktwice.model.driving.trajectory import FloatArray

LANES: Final = ("own", "left", "right")
RANKS: Final = 2
"""So many agents ahead are told for each lane."""
LEAD_FIELDS: Final = ("present", "gap_log_m", "speed", "standing", "braking", "fixed")
OBSTACLE_FIELDS: Final = ("present", "gap_log_m")
WALKERS: Final = 2
WALKER_FIELDS: Final = ("present", "along_log_m", "left", "speed_left")
ROAD_DISTANCES_M: Final = tuple(range(8, 81, 8))

FACTS: Final = (
    *(f"{lane}_{rank}_{field}" for lane in LANES for rank in range(RANKS) for field in LEAD_FIELDS),
    *(f"{lane}_obstacle_{field}" for lane in LANES for field in OBSTACLE_FIELDS),
    *(f"walker_{rank}_{field}" for rank in range(WALKERS) for field in WALKER_FIELDS),
    *(f"road_left_{distance}m" for distance in ROAD_DISTANCES_M),
)
FACT_GROUPS: Final = (
    *((LEAD_FIELDS,) * (len(LANES) * RANKS)),
    *((OBSTACLE_FIELDS,) * len(LANES)),
    *((WALKER_FIELDS,) * WALKERS),
    tuple(f"road_left_{distance}m" for distance in ROAD_DISTANCES_M),
)
"""Fields that tell of one agent, obstacle or walker, or of the road; in the order of `FACTS`."""
IS_YES_OR_NO: Final[npt.NDArray[np.bool_]] = np.array(
    [name.endswith(("present", "standing", "braking", "fixed")) for name in FACTS]
)
"""Which facts are told as probabilities."""

LANE_WIDTH_M: Final = 3.5
FACT_RANGE_M: Final = 80.0
WALKER_RANGE_M: Final = 60.0
WALKER_BESIDE_M: Final = 8.0
SPEED_SCALE_MS: Final = 10.0
WALKER_SPEED_SCALE_MS: Final = 2.0
WALKER_LEFT_SCALE_M: Final = 3.0
ROAD_SCALE_M: Final = 10.0
_STANDING_MS: Final = 0.5
_WALKER_AHEAD_M: Final = 45.0
_STANDING_AHEAD_M: Final = 60.0
_CLOSE_M: Final = 3.5

_MIRROR: Final[npt.NDArray[np.int64]] = np.array(
    [
        FACTS.index(
            name.replace("left_", "right_", 1)
            if name.startswith("left_")
            else name.replace("right_", "left_", 1)
            if name.startswith("right_")
            else name
        )
        for name in FACTS
    ]
)
_SIGNED: Final[npt.NDArray[np.bool_]] = np.array(
    [name.startswith("road_") or name.endswith(("_left", "speed_left")) for name in FACTS]
)


NEEDS_OWN_SPEED: Final[npt.NDArray[np.bool_]] = np.array(
    [name.endswith(("_speed", "_speed_left", "standing", "braking")) for name in FACTS]
)
"""Which facts pictures tell only to who knows how fast the car itself is: the others do not depend on it."""
TELLS_OF_OBJECT: Final[npt.NDArray[np.bool_]] = np.array(
    [not name.endswith("present") and not name.startswith("road_") for name in FACTS]
)
PRESENCE: Final[npt.NDArray[np.int64]] = np.array(
    [
        max(place for place in range(index + 1) if FACTS[place].endswith("present")) if tells else index
        for index, tells in enumerate(TELLS_OF_OBJECT)
    ]
)
"""Where the presence of each fact's object is told: at the beginning of its fields."""


def scene_facts(labelled: LabelledScene) -> FloatArray:
    """float32 [len(FACTS)] of one scene; NaN where a fact does not apply, all NaN without a route.

    Gaps are metres between bumpers, as log(1 + metres): an error of one metre matters more nearby. Speeds
    are over the ground along the route, divided by `SPEED_SCALE_MS`.
    """
    if labelled.scene.route is None:
        return np.full(len(FACTS), np.nan, np.float32)
    return facts_of(tracks_of(labelled.agents), labelled.scene.route)


def facts_of(tracks: Sequence[Track], route: FloatArray) -> FloatArray:
    """float32 [len(FACTS)]: what tracks tell; see `scene_facts`."""
    facts = dict.fromkeys(FACTS, float("nan"))
    facts |= {name: 0.0 for name in FACTS if name.endswith("present")}
    frame = RouteFrame(route)
    xy = np.array([(track.x_m, track.y_m) for track in tracks]).reshape(-1, 2)
    placed = list(zip(tracks, frame.places(xy), frame.headings(xy), strict=True))
    for lane, middle in zip(LANES, (0.0, LANE_WIDTH_M, -LANE_WIDTH_M), strict=True):
        ahead = sorted(
            (
                (max(0.0, along - (track.length_m + EGO_LENGTH_M) / 2), track, heading)
                for track, (along, left), heading in placed
                if track.kind != "pedestrian"
                and abs(left - middle) < LANE_WIDTH_M / 2
                and 0 < along < FACT_RANGE_M
            ),
            key=lambda lead: lead[0],
        )
        for rank, (gap, track, heading) in enumerate(ahead[:RANKS]):
            speed = track.speed_ms * math.cos(track.heading_rad - heading)
            values = (1.0, math.log1p(gap), speed / SPEED_SCALE_MS, *_states(track))
            facts |= _named(f"{lane}_{rank}", LEAD_FIELDS, values)
        obstacle = next((gap for gap, track, _ in ahead if _is_fixed(track)), None)
        if obstacle is not None:
            facts |= _named(f"{lane}_obstacle", OBSTACLE_FIELDS, (1.0, math.log1p(obstacle)))
    walkers = sorted(
        (along, left, track.speed_ms * math.sin(track.heading_rad - heading))
        for track, (along, left), heading in placed
        if track.kind == "pedestrian" and 0 < along < WALKER_RANGE_M and abs(left) < WALKER_BESIDE_M
    )
    for rank, (along, left, speed) in enumerate(walkers[:WALKERS]):
        place = math.log1p(along), left / WALKER_LEFT_SCALE_M
        facts |= _named(f"walker_{rank}", WALKER_FIELDS, (1.0, *place, speed / WALKER_SPEED_SCALE_MS))
    for distance in ROAD_DISTANCES_M:
        facts[f"road_left_{distance}m"] = float(route[distance // 4 - 1, 1]) / ROAD_SCALE_M
    return np.array([facts[name] for name in FACTS], np.float32)


def hazard_ahead(scene: Scene) -> bool:
    """Whether somebody walks, stands or has closed the lane ahead, or the lead is a length away.

    Needs the scene's route and tracks.
    """
    assert scene.route is not None
    assert scene.tracks is not None
    facts: dict[str, float] = dict(zip(FACTS, facts_of(scene.tracks, scene.route).tolist(), strict=True))

    def nearer(what: str, metres: float) -> bool:
        # What is not there is NaN, and not nearer than anything.
        return facts[what] < math.log1p(metres)

    return (
        nearer("walker_0_along_log_m", _WALKER_AHEAD_M)
        or nearer("own_obstacle_gap_log_m", _STANDING_AHEAD_M)
        or nearer("own_0_gap_log_m", _CLOSE_M)
        or (facts["own_0_standing"] == 1 and nearer("own_0_gap_log_m", _STANDING_AHEAD_M))
    )


def mirrored(facts: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Facts [..., len(FACTS)] of a scene whose left and right are swapped."""
    swapped: npt.NDArray[np.float32] = np.where(_SIGNED, -facts[..., _MIRROR], facts[..., _MIRROR])
    return swapped


def _states(track: Track) -> tuple[float, float, float]:
    standing = abs(track.speed_ms) < _STANDING_MS
    return float(standing), float("brake" in track.lights), float(_is_fixed(track))


def _is_fixed(track: Track) -> bool:
    """Whether it has to be driven round: cones, barriers, vehicles with hazard lights."""
    return track.kind in ("cone", "barrier") or {"left", "right"} <= track.lights


def _named(prefix: str, fields: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    return {f"{prefix}_{field}": value for field, value in zip(fields, values, strict=True)}
