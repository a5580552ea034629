"""What a score is measured in: the ego, the vehicle, the map, the traffic; and what cannot be scored."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

STEP_S: Final = 0.1
STEPS: Final = 40
"""Steps that are simulated and scored: 4 s."""
LONG_STEPS: Final = 50
"""The last step of a track that v1.1 needs: it looks 0.9 s beyond the last pose."""

# Columns of a state: pose and motion of the rear axle, then the front wheel, then the turn.
X, Y, HEADING, SPEED, SPEED_Y, ACCELERATION, ACCELERATION_Y = range(7)
STEERING, STEERING_RATE, YAW_RATE, YAW_ACCELERATION = range(7, 11)
STATE_SIZE: Final = 11

_FARTHEST_M: Final = 1e5
_SMALLEST_SIDE_M: Final = 1e-3


class ScoreError(ValueError):
    """A world or a plan that cannot be scored; the text says what is wrong.

    Attributes:
        place: which part is wrong, as a path such as ``lanes/3`` or ``plans/0``.
    """

    def __init__(self, place: str, detail: str) -> None:
        super().__init__(f"{place}: {detail}")
        self.place, self.detail = place, detail


@dataclass(frozen=True)
class EgoVehicle:
    """The ego's body, measured from its rear axle."""

    width_m: float
    front_m: float
    rear_m: float
    wheelbase_m: float

    def __post_init__(self) -> None:
        sides = (self.width_m, self.front_m, self.wheelbase_m, self.front_m + self.rear_m)
        if not all(math.isfinite(side) and _SMALLEST_SIDE_M <= side <= 100 for side in sides):
            raise ScoreError("vehicle", "width, front, wheelbase and length lie between 1 mm and 100 m")

    @property
    def length_m(self) -> float:
        """Bumper to bumper."""
        return self.front_m + self.rear_m

    @property
    def centre_m(self) -> float:
        """How far the box's centre lies ahead of the rear axle."""
        return self.length_m / 2 - self.rear_m


PACIFICA: Final = EgoVehicle(width_m=2.297, front_m=4.049, rear_m=1.127, wheelbase_m=3.089)
"""The car of nuPlan and NAVSIM."""


@dataclass(frozen=True, eq=False)
class Area:
    """A part of the ground.

    Attributes:
        rings: float64 [k, 2] each, closed without repeating the first point; a point is inside when an
            odd number of rings contains it, so a hole is a ring too.
        edges: float64 [e, 4], the rings' edges (x, y, x, y).
        low, high: float64 [2], the corners of the box around it.
    """

    rings: tuple[Array, ...]
    edges: Array = field(init=False, repr=False)
    low: Array = field(init=False, repr=False)
    high: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rings = []
        for given in self.rings:
            ring = np.asarray(given, dtype=np.float64)
            if ring.ndim != 2 or ring.shape[1] != 2:
                raise ScoreError("ring", f"a ring has shape [k, 2], not {list(ring.shape)}")
            if len(ring) > 1 and (ring[0] == ring[-1]).all():
                ring = ring[:-1]
            if len(ring) < 3:
                raise ScoreError("ring", "a ring has at least three different points")
            _check_finite(ring, "ring")
            rings.append(ring)
        if not rings:
            raise ScoreError("ring", "an area has at least one ring")
        object.__setattr__(self, "rings", tuple(rings))
        edges = np.concatenate([np.hstack([ring, np.roll(ring, -1, axis=0)]) for ring in rings])
        object.__setattr__(self, "edges", edges)
        object.__setattr__(self, "low", edges[:, :2].min(axis=0))
        object.__setattr__(self, "high", edges[:, :2].max(axis=0))


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane, or a lane's way over an intersection; ``on_route`` where the ego may go along it."""

    lane_id: str
    area: Area
    on_route: bool


@dataclass(frozen=True, eq=False)
class RedLight:
    """A lane that a red light closes.

    Attributes:
        light_id: the caller's name for it.
        area: the lane behind the light.
        red: bool [41], the steps at which it is red; always where None.
    """

    light_id: str
    area: Area
    red: BoolArray | None = None

    def __post_init__(self) -> None:
        if self.red is not None and self.red.shape != (STEPS + 1,):
            raise ScoreError("light", f"red has shape [{STEPS + 1}], not {list(self.red.shape)}")


@dataclass(frozen=True, eq=False)
class TrackedBox:
    """Something that the ego could hit.

    Attributes:
        track_id: the caller's name for it.
        is_agent: whether it is a vehicle, a cyclist or a pedestrian, and no thing that always stands.
        length_m, width_m: the box; length lies along the heading.
        poses: float64 [t, 3] (x, y, heading) of the box's centre from now on at 10 Hz; NaN where absent.
        first_speed_mps: its speed when it is first there.
        kind: what it is, for people; it changes no score.
    """

    track_id: str
    is_agent: bool
    length_m: float
    width_m: float
    poses: Array
    first_speed_mps: float
    kind: str = ""

    def __post_init__(self) -> None:
        if self.poses.ndim != 2 or self.poses.shape[1] != 3:
            raise ScoreError(self.track_id, f"poses have shape [t, 3], not {list(self.poses.shape)}")
        there = np.isfinite(self.poses)
        if (there.any(axis=1) != there.all(axis=1)).any() or np.isinf(self.poses).any():
            raise ScoreError(self.track_id, "a pose is three finite numbers, or absent as a whole")
        if not there.any():
            raise ScoreError(self.track_id, "has no future: none of its poses is there")
        if np.abs(self.poses[there]).max() > _FARTHEST_M:
            raise ScoreError(self.track_id, f"poses lie within {_FARTHEST_M:g} m")
        sides = (self.length_m, self.width_m)
        if not all(math.isfinite(side) and _SMALLEST_SIDE_M <= side <= 100 for side in sides):
            raise ScoreError(self.track_id, "length and width lie between 1 mm and 100 m")
        if not (math.isfinite(self.first_speed_mps) and self.first_speed_mps >= 0):
            raise ScoreError(self.track_id, "a speed is a finite number that is not negative")

    @property
    def is_stopped(self) -> bool:
        """Whether hitting it is a fault whatever the direction; it is judged when it is first seen."""
        return not self.is_agent or self.first_speed_mps <= 0.05


@dataclass(frozen=True, eq=False)
class World:
    """One moment and its next seconds, in one frame for everything.

    A layer that is None is not known: what needs it is not scored. An empty layer is known to be empty.

    Attributes:
        ego: float64 [11], the state now; see the columns of this module.
        vehicle: the ego's body.
        tracks: everything that could be hit.
        lanes: all lanes around.
        intersections: where lanes cross.
        drivable: where a car may be; ``intersections`` count as such, too.
        lights: the lanes that are closed by a red light.
        centreline: float64 [k, 2], the middle of the lanes that the reference follows.
        past: float64 [h, 11], states at 10 Hz before now, oldest first; the last one is 0.1 s old.
        careful: where lanes or the drivable area are not known, whom the ego touches beside it is the ego's
            fault; otherwise such plans have no score where these would decide.
    """

    ego: Array
    vehicle: EgoVehicle = PACIFICA
    tracks: tuple[TrackedBox, ...] | None = None
    lanes: tuple[Lane, ...] | None = None
    intersections: tuple[Area, ...] | None = None
    drivable: tuple[Area, ...] | None = None
    lights: tuple[RedLight, ...] | None = None
    centreline: Array | None = None
    past: Array | None = None
    careful: bool = False

    def __post_init__(self) -> None:
        if self.ego.shape != (STATE_SIZE,):
            raise ScoreError("ego", f"a state has {STATE_SIZE} values, not {list(self.ego.shape)}")
        _check_finite(self.ego, "ego")
        if self.centreline is not None:
            if self.centreline.ndim != 2 or self.centreline.shape[1] != 2 or len(self.centreline) < 2:
                raise ScoreError("centreline", "a centre line has at least two points (x, y)")
            _check_finite(self.centreline, "centreline")
            if not np.ptp(self.centreline, axis=0).any():
                raise ScoreError("centreline", "all its points are the same")
        if self.past is not None:
            if self.past.ndim != 2 or self.past.shape[1] != STATE_SIZE:
                raise ScoreError("past", f"has shape [h, {STATE_SIZE}], not {list(self.past.shape)}")
            _check_finite(self.past, "past")
        names = [track.track_id for track in self.tracks or ()]
        if twice := {name for name in names if names.count(name) > 1}:
            raise ScoreError("tracks", f"occur twice: {', '.join(sorted(twice))}")


def _check_finite(values: Array, place: str) -> None:
    if not np.isfinite(values).all() or np.abs(values).max(initial=0) > _FARTHEST_M:
        raise ScoreError(place, f"holds values that are not finite, or beyond ±{_FARTHEST_M:g}")
