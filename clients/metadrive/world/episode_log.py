"""What an episode leaves behind: everyone's poses at 10 Hz."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from looktwice.clients.metadrive.world.actors import Body, Vehicle
from looktwice.clients.metadrive.world.drifts import strays
from looktwice.clients.metadrive.world.roads import Array, RoadMap
from looktwice.model.driving.scene import AgentKind, Light

Outcome = Literal["time", "route_end", "collision"]

BRAKE_LIGHT: Final = 1
LEFT_LIGHT: Final = 2
RIGHT_LIGHT: Final = 4


@dataclass(frozen=True, eq=False)
class ActorLog:
    """One actor over the episode.

    Attributes:
        poses: float64 [steps, 3] x, y, heading in the world; NaN while it is far away.
        lights: uint8 [steps], bits `BRAKE_LIGHT`, `LEFT_LIGHT`, `RIGHT_LIGHT`.
        phase: float32 [steps], metres walked, for the gait.
    """

    actor_id: int
    kind: AgentKind
    model: str
    tint: float
    size: tuple[float, float, float]
    poses: Array
    lights: npt.NDArray[np.uint8]
    phase: Array


@dataclass(frozen=True, eq=False)
class EpisodeLog:
    """What happened at 10 Hz.

    Attributes:
        ego: float64 [steps, 4] x, y, heading, signed speed.
        lanes: int64 [steps] the lane the ego's centre is in.
        lane_offsets: float64 [steps] metres to the left of that lane's centre.
        rails, progress: the rail followed and the place along the route.
        strays: bool [steps], whether the ego is on its way off its line
            (`looktwice.clients.metadrive.world.drifts`).
    """

    seed: int
    road_map: RoadMap
    outcome: Outcome
    ego: Array
    lanes: npt.NDArray[np.int64]
    lane_offsets: Array
    rails: npt.NDArray[np.int64]
    progress: Array
    strays: npt.NDArray[np.bool_]
    actors: tuple[ActorLog, ...]


class Recorder:
    """Remembers an episode as it goes on.

    Args:
        seed, road_map: the episode's.
        bodies: everyone who can ever appear.
        steps: at most.

    Attributes:
        live: the log with room for all steps and actors; what has not happened yet is NaN or 0 in it.
        steps: so many are remembered.
    """

    def __init__(self, seed: int, road_map: RoadMap, bodies: Sequence[Body], steps: int) -> None:
        self.steps = 0
        self._places = {body.actor_id: place for place, body in enumerate(bodies)}
        self.live = EpisodeLog(
            seed,
            road_map,
            "time",
            np.full((steps, 4), np.nan),
            np.zeros(steps, np.int64),
            np.zeros(steps),
            np.zeros(steps, np.int64),
            np.zeros(steps),
            np.zeros(steps, np.bool_),
            tuple(
                ActorLog(
                    body.actor_id,
                    body.kind,
                    body.model,
                    body.tint,
                    body.size,
                    np.full((steps, 3), np.nan),
                    np.zeros(steps, np.uint8),
                    np.zeros(steps),
                )
                for body in bodies
            ),
        )

    def make_room(self, steps: int) -> None:
        """Let there be room for at least so many steps in all."""
        more = steps - len(self.live.ego)
        if more <= 0:
            return
        live = self.live
        grown = {
            name: _longer(getattr(live, name), more)
            for name in ("ego", "lanes", "lane_offsets", "rails", "progress", "strays")
        }
        actors = tuple(
            replace(
                actor, **{name: _longer(getattr(actor, name), more) for name in ("poses", "lights", "phase")}
            )
            for actor in live.actors
        )
        self.live = replace(live, actors=actors, **grown)

    def add(self, ego: Vehicle, lane: int, lane_offset: float, near: Sequence[Body]) -> None:
        """Remember a moment."""
        log, step = self.live, self.steps
        log.ego[step] = ego.x, ego.y, ego.heading, ego.speed
        log.lanes[step], log.lane_offsets[step] = lane, lane_offset
        log.rails[step], log.progress[step] = ego.rail, ego.progress
        log.strays[step] = strays(ego)
        for body in near:
            actor = log.actors[self._places[body.actor_id]]
            actor.poses[step] = body.x, body.y, body.heading
            actor.lights[step], actor.phase[step] = _lights(body), body.phase
        self.steps += 1

    def log(self, outcome: Outcome) -> EpisodeLog:
        """What happened, without those who never came near."""
        past, live = slice(0, self.steps), self.live
        actors = tuple(
            replace(actor, poses=actor.poses[past], lights=actor.lights[past], phase=actor.phase[past])
            for actor in live.actors
            if np.isfinite(actor.poses[past]).any()
        )
        return EpisodeLog(
            live.seed,
            live.road_map,
            outcome,
            live.ego[past],
            live.lanes[past],
            live.lane_offsets[past],
            live.rails[past],
            live.progress[past],
            live.strays[past],
            actors,
        )


def _longer(track: Any, steps: int) -> Any:
    """``track`` with ``steps`` more rows of what has not happened yet."""
    empty = np.nan if track.dtype.kind == "f" and track.ndim > 1 else 0
    return np.concatenate([track, np.full((steps, *track.shape[1:]), empty, track.dtype)])


def lights_on(bits: int) -> frozenset[Light]:
    """The lights that an `ActorLog`'s bits say are on."""
    names: dict[int, Light] = {BRAKE_LIGHT: "brake", LEFT_LIGHT: "left", RIGHT_LIGHT: "right"}
    return frozenset(name for bit, name in names.items() if bits & bit)


def _lights(body: Body) -> int:
    if not isinstance(body, Vehicle):
        return 0
    lights = 0
    if body.acceleration < -0.6 or (body.speed < 0.1 and not body.hazard_lights):
        lights |= BRAKE_LIGHT
    if body.hazard_lights or body.indicator > 0:
        lights |= LEFT_LIGHT
    if body.hazard_lights or body.indicator < 0:
        lights |= RIGHT_LIGHT
    return lights
