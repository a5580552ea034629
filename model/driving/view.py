"""What the front cameras show now: who is where, and how the road runs. Nothing of the future.

Made from a scene's annotations, of which only the past and the present are looked at.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.lead import LANE_HALF_WIDTH_M
from looktwice.model.driving.scene import EGO_LENGTH_M, Agent, AgentKind, LabelledScene, Scene
from looktwice.model.driving.tracks import Track, track_of
from looktwice.model.driving.trajectory import HISTORY_STEPS, STEP_S, FloatArray, present_speed

Array = npt.NDArray[np.float64]
Place = Literal["my lane", "the left lane", "the right lane", "the left side", "the right side"]
Bend = Literal["left", "right"]

_HALF_VIEW_RAD: Final = float(np.deg2rad(60))
_TELE_HALF_VIEW_RAD: Final = float(np.deg2rad(15))
_SEEN_WITHIN_M: Final = {
    "vehicle": (60.0, 90.0),
    "pedestrian": (30.0, 50.0),
    "cone": (25.0, 45.0),
    "barrier": (30.0, 55.0),
}
"""With the wide camera and with the long one: farther ones are a few pixels."""
_LANE_M: Final = 2 * LANE_HALF_WIDTH_M
_LOOK_AHEAD_M: Final = 45.0
_BEND_RAD: Final = float(np.deg2rad(15))
_TOUCH_M: Final = 1.0
_TURN_RAD: Final = float(np.deg2rad(30))
_PAST_STEPS: Final = 10
"""Motion is judged over the last second; clips show two."""
_STRAIGHT: Final[Array] = np.array([[0.0, 0.0], [100.0, 0.0]])


@dataclass(frozen=True)
class Sight:
    """Somebody or something that is to be seen.

    Attributes:
        kind: what it is.
        ahead_m: from bumper to bumper along x.
        place: where, seen from the ego's lane.
        speed_ms: along x over the last second, over ground; NaN where it came into view since.
        brakes: whether its brake lights are on.
    """

    kind: AgentKind
    ahead_m: float
    place: Place
    speed_ms: float
    brakes: bool = False


@dataclass(frozen=True)
class View:
    """What is to be seen.

    Attributes:
        speed_ms: the ego's own.
        sights: the nearest first.
        bend: which way the ego's lane bends within reach, or None.
        bend_m: where it begins to.
        turns: which ways a lane leaves the ego's, at a junction for one, within reach.
        beside: on which sides there is another lane of the same way.
    """

    speed_ms: float
    sights: tuple[Sight, ...]
    bend: Bend | None
    bend_m: float
    turns: frozenset[Bend] = frozenset()
    beside: frozenset[Bend] = frozenset()

    def first(self, *kinds: AgentKind, places: tuple[Place, ...]) -> Sight | None:
        """The nearest sight of some kinds in some places."""
        return next((each for each in self.sights if each.kind in kinds and each.place in places), None)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Annotations of a scene: who is around, and the centre lines of the lanes, float32 [k, 2] each."""

    agents: tuple[Agent, ...]
    lane_lines: tuple[FloatArray, ...]

    @classmethod
    def of(cls, labelled: LabelledScene) -> Surroundings:
        """Those of a labelled scene."""
        return cls(labelled.agents, labelled.lane_lines)


def view_of(scene: Scene, surroundings: Surroundings) -> View:
    """What the cameras of a scene show. The own lane is the way to go, where that is known."""
    lane = _own_lane(surroundings.lane_lines) if scene.route is None else _from_here(scene.route)
    known = [(agent, track) for agent in surroundings.agents if (track := track_of(agent)) is not None]
    tracks = [track for _, track in known]
    sights = [_sight(track, _speed_ms(agent), lane) for agent, track in known if visible(track, tracks)]
    bend, bend_m = bend_along(lane)
    lines = [line.astype(np.float64) for line in surroundings.lane_lines if len(line) > 1]
    turns, beside = _turns(lines, lane), beside_of(lines)
    return View(present_speed(scene.history), _nearest_first(sights), bend, bend_m, turns, beside)


def view_along(history: FloatArray, route: FloatArray | None, tracks: Sequence[Track]) -> View:
    """What is in view as far as tracks and the way to go tell it: nothing is known of other lanes.

    Args:
        history: float32 [16, 4].
        route: float32 [20, 2]; the road is straight where there is none.
        tracks: what is around; a vehicle's speed is that along x.
    """
    lane = _STRAIGHT if route is None else _from_here(route)
    sights = [
        _sight(track, track.speed_ms * float(np.cos(track.heading_rad)), lane)
        for track in tracks
        if visible(track, tracks)
    ]
    return View(present_speed(history), _nearest_first(sights), *bend_along(lane))


def visible(track: Track, others: Sequence[Track]) -> bool:
    """Whether front cameras show it: near enough, in their field of view, not behind a vehicle."""
    if not track.x_m > EGO_LENGTH_M / 2:
        return False
    bearing, distance = float(np.arctan2(track.y_m, track.x_m)), float(np.hypot(track.x_m, track.y_m))
    near, far = _SEEN_WITHIN_M[track.kind]
    if abs(bearing) > _HALF_VIEW_RAD or distance > (far if abs(bearing) < _TELE_HALF_VIEW_RAD else near):
        return False
    return not any(_hides(other, bearing, distance) for other in others if other is not track)


def _hides(other: Track, bearing: float, distance: float) -> bool:
    """Whether a vehicle stands nearer in the same direction and covers the middle of what is behind."""
    nearer = np.hypot(other.x_m, other.y_m)
    if other.kind != "vehicle" or not other.x_m > 0 or nearer > distance - 2:
        return False
    return bool(abs(np.arctan2(other.y_m, other.x_m) - bearing) < np.arctan2(other.width_m / 2, nearer))


def _sight(track: Track, speed_ms: float, lane: Array) -> Sight:
    place = lane_place(_left_of(lane, np.array([track.x_m, track.y_m])))
    length_m = track.length_m if track.kind == "vehicle" else 0.0
    ahead_m = max(0.0, track.x_m - (EGO_LENGTH_M + length_m) / 2)
    return Sight(track.kind, ahead_m, place, speed_ms, "brake" in track.lights)


def lane_place(left_m: float) -> Place:
    """The place of what is so far to the left of the middle of the own lane."""
    if abs(left_m) <= LANE_HALF_WIDTH_M:
        return "my lane"
    if abs(left_m) < LANE_HALF_WIDTH_M + _LANE_M:
        return "the left lane" if left_m > 0 else "the right lane"
    return "the left side" if left_m > 0 else "the right side"


def _speed_ms(agent: Agent) -> float:
    """Along x over the last second: all poses are in the ego frame of now, so it is over ground."""
    before = agent.poses[HISTORY_STEPS - 1 - _PAST_STEPS]
    return float(agent.present[0] - before[0]) / (_PAST_STEPS * STEP_S)


def _nearest_first(sights: Iterable[Sight]) -> tuple[Sight, ...]:
    return tuple(sorted(sights, key=lambda each: each.ahead_m))


def _own_lane(lane_lines: tuple[FloatArray, ...]) -> Array:
    """The centre line that the ego drives on, from here onwards, [k, 2]; straight ahead where unknown."""
    best = None
    for line in lane_lines:
        points = line.astype(np.float64)
        distances = np.linalg.norm(points, axis=1)
        nearest = int(distances.argmin())
        onwards = points[nearest:]
        if distances[nearest] > 3.0 or len(onwards) < 2:
            continue
        heading = onwards[1] - onwards[0]
        if abs(np.arctan2(heading[1], heading[0])) > np.deg2rad(30):
            continue
        length = float(np.linalg.norm(np.diff(onwards, axis=0), axis=1).sum())
        rating = (round(distances[nearest], 1), -length)
        if best is None or rating < best[0]:
            best = (rating, onwards)
    return _STRAIGHT if best is None else best[1]


def _left_of(lane: Array, point: Array) -> float:
    """How far a point lies to the left of a line, which goes straight on behind its end, in m."""
    last = lane[-1] - lane[-2]
    line = np.concatenate([lane, [lane[-1] + 100 * last / max(float(np.linalg.norm(last)), 1e-6)]])
    start, step = line[:-1], np.diff(line, axis=0)
    along = np.clip(((point - start) * step).sum(1) / np.maximum((step**2).sum(1), 1e-9), 0, 1)
    away = point - (start + along[:, None] * step)
    nearest = int(np.linalg.norm(away, axis=1).argmin())
    side = step[nearest, 0] * away[nearest, 1] - step[nearest, 1] * away[nearest, 0]
    return float(np.copysign(np.linalg.norm(away[nearest]), side))


def bend_of(way: npt.NDArray[np.floating]) -> tuple[Bend | None, float]:
    """Which way a way [k, 2] from the ego bends within reach, and where it begins to, in m."""
    return bend_along(_from_here(way))


def _from_here(way: npt.NDArray[np.floating]) -> Array:
    return np.concatenate([np.zeros((1, 2)), np.asarray(way, np.float64)])


def bend_along(lane: Array) -> tuple[Bend | None, float]:
    """The same of a line [k, 2] that begins beside the ego."""
    steps = np.diff(lane, axis=0)
    behind = np.cumsum(np.linalg.norm(steps, axis=1)) - np.linalg.norm(steps, axis=1)
    turned = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    turned -= turned[0]
    within = behind < _LOOK_AHEAD_M
    strongest = int(np.abs(np.where(within, turned, 0)).argmax())
    if abs(turned[strongest]) < _BEND_RAD:
        return None, 0.0
    begins = int(np.flatnonzero(np.abs(turned) > _BEND_RAD / 3)[0])
    return ("left" if turned[strongest] > 0 else "right"), float(behind[begins])


def _turns(lines: list[Array], lane: Array) -> frozenset[Bend]:
    """Ways that lines which touch the ego's lane ahead turn off to."""
    found: set[Bend] = set()
    reach = lane[np.linalg.norm(lane, axis=1) < _LOOK_AHEAD_M]
    for line in lines:
        apart = np.linalg.norm(line[:, None] - reach, axis=2)
        if not len(reach) or apart.min() > _TOUCH_M:
            continue
        onwards = line[int(np.unravel_index(int(apart.argmin()), apart.shape)[0]) :]
        heading = np.unwrap(np.arctan2(*np.diff(onwards, axis=0).T[::-1]))
        if len(heading) and abs(heading[0]) < np.pi / 2:
            turned = heading[int(np.abs(heading).argmax())]
            if abs(turned) > _TURN_RAD:
                found.add("left" if turned > 0 else "right")
    return frozenset(found)


def beside_of(lines: list[Array]) -> frozenset[Bend]:
    """Sides on which a line runs beside the ego, the same way, a lane away."""
    found: set[Bend] = set()
    for line in lines:
        nearest = int(np.abs(line[:-1, 0]).argmin())
        x, y = line[nearest]
        step = line[nearest + 1] - line[nearest]
        same_way = abs(np.arctan2(step[1], step[0])) < _TURN_RAD
        if same_way and abs(x) < _LANE_M and LANE_HALF_WIDTH_M < abs(y) < LANE_HALF_WIDTH_M + _LANE_M:
            found.add("left" if y > 0 else "right")
    return frozenset(found)
