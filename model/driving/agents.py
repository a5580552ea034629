"""Other road users and obstacles: what they are, and where they were and will be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from looktwice.model.driving.trajectory import FUTURE_STEPS, HISTORY_STEPS, FloatArray

TRACK_STEPS: Final = HISTORY_STEPS + FUTURE_STEPS
"""Rows of an agent's track: 16 past poses (the last one is now), then 64 future ones."""

AgentKind = Literal["vehicle", "pedestrian", "cone", "barrier"]
AGENT_KINDS: Final[tuple[AgentKind, ...]] = ("vehicle", "pedestrian", "cone", "barrier")
ROAD_USERS: Final[tuple[AgentKind, ...]] = ("vehicle", "pedestrian")
"""Those that move; all others are obstacles."""

Light = Literal["brake", "left", "right"]
LIGHTS: Final[tuple[Light, ...]] = ("brake", "left", "right")
"""Lights of a vehicle that others act on; left and right together are hazard lights."""


class SceneError(ValueError):
    """A scene that cannot be planned for; the text says what is wrong with it."""


@dataclass(frozen=True, eq=False)
class Agent:
    """Another road user or obstacle as an oriented box, over past and future.

    Attributes:
        agent_id: stable within an episode.
        kind: what it is.
        length_m, width_m, height_m: the box; length lies along the heading.
        poses: float32 [80, 3] (x, y, heading) of the box's centre, ego frame of the scene's instant,
            row 15 is now; NaN where the agent is absent.
        lights: those that are on now.
    """

    agent_id: int
    kind: AgentKind
    length_m: float
    width_m: float
    height_m: float
    poses: FloatArray
    lights: frozenset[Light] = frozenset()

    def __post_init__(self) -> None:
        if self.poses.shape != (TRACK_STEPS, 3):
            raise SceneError(f"agent poses must have shape [80, 3], got {list(self.poses.shape)}")
        if unknown := set(self.lights) - set(LIGHTS):
            raise SceneError(f"unknown lights: {', '.join(sorted(unknown))}; known are {', '.join(LIGHTS)}")

    @property
    def future(self) -> FloatArray:
        """float32 [64, 3], aligned with a trajectory's rows."""
        return self.poses[HISTORY_STEPS:]

    @property
    def present(self) -> FloatArray:
        """float32 [3], NaN when absent now."""
        row: FloatArray = self.poses[HISTORY_STEPS - 1]
        return row
