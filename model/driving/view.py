"""What the front cameras show now: who is where, and how the road runs. Nothing of the future.

Made from a scene's annotations, of which only the past and the present are looked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from model.driving.lead import LANE_HALF_WIDTH_M
from model.driving.scene import EGO_LENGTH_M, Agent, AgentKind, LabelledScene, Scene
from model.driving.trajectory import HISTORY_STEPS, STEP_S, FloatArray, present_speed

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
    """What the cameras of a scene show."""
    lane = _own_lane(surroundings.lane_lines)
    speed_ms = present_speed(scene.history)
    seen = [agent for agent in surroundings.agents if _visible(agent, surroundings.agents)]
    sights = sorted((_sight(agent, lane) for agent in seen), key=lambda each: each.ahead_m)
    bend, bend_m = _bend(lane)
    lines = [line.astype(np.float64) for line in surroundings.lane_lines if len(line) > 1]
    return View(speed_ms, tuple(sights), bend, bend_m, _turns(lines, lane), _beside(lines))


def _visible(agent: Agent, others: tuple[Agent, ...]) -> bool:
    x, y = (float(value) for value in agent.present[:2])
    if not x > EGO_LENGTH_M / 2:  # False where absent (NaN)
        return False
    bearing, distance = float(np.arctan2(y, x)), float(np.hypot(x, y))
    near, far = _SEEN_WITHIN_M[agent.kind]
    if abs(bearing) > _HALF_VIEW_RAD or distance > (far if abs(bearing) < _TELE_HALF_VIEW_RAD else near):
        return False
    return not any(_hides(other, bearing, distance) for other in others if other is not agent)


def _hides(other: Agent, bearing: float, distance: float) -> bool:
    """Whether a vehicle stands nearer in the same direction and covers the middle of what is behind."""
    x, y = (float(value) for value in other.present[:2])
    if other.kind != "vehicle" or not x > 0 or np.hypot(x, y) > distance - 2:
        return False
    return bool(abs(np.arctan2(y, x) - bearing) < np.arctan2(other.width_m / 2, np.hypot(x, y)))


def _sight(agent: Agent, lane: Array) -> Sight:
    x, y = (float(value) for value in agent.present[:2])
    left = _left_of(lane, np.array([x, y]))
    place: Place = "my lane"
    if abs(left) > LANE_HALF_WIDTH_M:
        side: tuple[Place, Place] = (
            ("the left lane", "the right lane")
            if abs(left) < LANE_HALF_WIDTH_M + _LANE_M
            else ("the left side", "the right side")
        )
        place = side[0] if left > 0 else side[1]
    before = agent.poses[HISTORY_STEPS - 1 - _PAST_STEPS]
    # All poses are in the ego frame of now: differences are speeds over ground.
    speed_ms = float(x - before[0]) / (_PAST_STEPS * STEP_S)
    length = agent.length_m if agent.kind == "vehicle" else 0.0
    ahead_m = max(0.0, x - (EGO_LENGTH_M + length) / 2)
    return Sight(agent.kind, ahead_m, place, speed_ms, "brake" in agent.lights)


def _own_lane(lane_lines: tuple[FloatArray, ...]) -> Array:
    """The centre line that the ego drives on, from here onwards, [k, 2]; straight ahead where unknown."""
    best, straight = None, np.array([[0.0, 0.0], [100.0, 0.0]])
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
    return straight if best is None else best[1]


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


def _bend(lane: Array) -> tuple[Bend | None, float]:
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


def _beside(lines: list[Array]) -> frozenset[Bend]:
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
