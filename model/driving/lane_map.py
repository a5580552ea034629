"""What NAVSIM's scores ask of the map around a scene: lanes, intersections, the route's centre line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.agents import SceneError
from looktwice.model.driving.trajectory import FloatArray

LANE_MAP_CM: Final = 100
"""A lane map is exact to the centimetre: so many of its units are one metre."""
_FARTHEST_CM: Final = 2**31 - 1


@dataclass(frozen=True, eq=False)
class LaneArea:
    """A lane of one road, or its way over an intersection.

    Attributes:
        lane_id: stable within an episode.
        ring: float32 [k, 2], its outline in the ego frame, counter-clockwise and not closed.
        on_route: whether it belongs to a road of the route; in any other lane the ego drives against the
            traffic or away from its route.
    """

    lane_id: int
    ring: FloatArray
    on_route: bool

    def __post_init__(self) -> None:
        object.__setattr__(self, "ring", to_the_centimetre(self.ring, 3, f"lane {self.lane_id}"))


@dataclass(frozen=True, eq=False)
class LaneMap:
    """The map around a scene.

    Attributes:
        lanes: all lanes around.
        intersections: rings, float32 [k, 2] each; a point is in an intersection when an odd number of them
            contains it (islands are rings too).
        centreline: float32 [k, 2], the middle of the lanes to follow, from behind the ego on. It follows the
            map and the navigation alone, as the scene's route does.
        has_lights: whether there are traffic lights in the world. Where there are none, none is red; where
            there are some, nothing is known of them.
    """

    lanes: tuple[LaneArea, ...]
    intersections: tuple[FloatArray, ...]
    centreline: FloatArray
    has_lights: bool

    def __post_init__(self) -> None:
        rings = tuple(to_the_centimetre(ring, 3, "an intersection") for ring in self.intersections)
        object.__setattr__(self, "intersections", rings)
        object.__setattr__(self, "centreline", to_the_centimetre(self.centreline, 2, "the centre line"))


def to_the_centimetre(points: npt.ArrayLike, least: int, what: str) -> FloatArray:
    """Points [k, 2] in metres as float32, rounded to what a lane map holds.

    Raises:
        SceneError: fewer than ``least`` points, points of another shape, or not finite.
    """
    given = np.asarray(points, np.float64)
    if given.ndim != 2 or given.shape[1] != 2 or len(given) < least:
        raise SceneError(f"{what} needs at least {least} points [k, 2], got {list(given.shape)}")
    if not np.isfinite(given).all() or np.abs(given).max() * LANE_MAP_CM > _FARTHEST_CM:
        raise SceneError(f"{what} has points that are not finite, or too far away")
    return (np.round(given * LANE_MAP_CM) / LANE_MAP_CM).astype(np.float32)
