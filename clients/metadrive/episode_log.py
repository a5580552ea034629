"""What an episode leaves behind: everyone's poses at 10 Hz."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from clients.metadrive.roads import Array, RoadMap
from model.driving.scene import AgentKind

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
    """

    seed: int
    road_map: RoadMap
    outcome: Outcome
    ego: Array
    lanes: npt.NDArray[np.int64]
    lane_offsets: Array
    rails: npt.NDArray[np.int64]
    progress: Array
    actors: tuple[ActorLog, ...]
