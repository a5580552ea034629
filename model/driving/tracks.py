"""Tracked objects as an optional input of a scene: what a car's own tracker or a simulator tells."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from looktwice.model.driving.agents import (
    AGENT_KINDS,
    LIGHTS,
    Agent,
    AgentKind,
    Light,
    SceneError,
)
from looktwice.model.driving.trajectory import HISTORY_STEPS, MAX_POSITION_M, STEP_S

MAX_TRACKS: Final = 16
TRACK_REACH_M: Final = 100.0
"""Agents farther away are left out of the tracks of a labelled scene."""
_AHEAD_BONUS_M: Final = 15.0
"""What is ahead counts as nearer by this: it decides more."""
_MAX_SPEED_MS: Final = 150.0
_MAX_SIZE_M: Final = 50.0
SPEED_STEPS: Final = 2


@dataclass(frozen=True)
class Track:
    """One tracked road user or obstacle, now, in the ego frame.

    Attributes:
        x_m, y_m, heading_rad: the centre of its box.
        speed_ms: along its heading over the ground.
        length_m, width_m: of its box; length lies along the heading.
        kind: what it is.
        lights: those that are on; left and right together are hazard lights.
    """

    x_m: float
    y_m: float
    heading_rad: float
    speed_ms: float
    length_m: float
    width_m: float
    kind: AgentKind
    lights: frozenset[Light] = frozenset()

    def __post_init__(self) -> None:
        for name, most in (
            ("x_m", MAX_POSITION_M),
            ("y_m", MAX_POSITION_M),
            ("heading_rad", 4 * math.pi),
            ("speed_ms", _MAX_SPEED_MS),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and abs(value) <= most):
                raise SceneError(f"a track's {name} must be finite and within ±{most:g}, got {value}")
        for name in ("length_m", "width_m"):
            value = getattr(self, name)
            if not 0 < value <= _MAX_SIZE_M:
                raise SceneError(f"a track's {name} must be above 0 and at most {_MAX_SIZE_M:g}, got {value}")
        if self.kind not in AGENT_KINDS:
            raise SceneError(f"unknown kind {self.kind!r}; known are {', '.join(AGENT_KINDS)}")
        if unknown := set(self.lights) - set(LIGHTS):
            raise SceneError(f"unknown lights: {', '.join(sorted(unknown))}; known are {', '.join(LIGHTS)}")


def nearest_tracks(tracks: Iterable[Track], count: int = MAX_TRACKS) -> tuple[Track, ...]:
    """At most ``count`` tracks, the nearest first; what is ahead counts as nearer."""
    return tuple(sorted(tracks, key=_rank)[:count])


def check_tracks(tracks: Sequence[Track]) -> tuple[Track, ...]:
    """The tracks of a scene; raises `SceneError` when there are more than `MAX_TRACKS`."""
    if len(tracks) > MAX_TRACKS:
        raise SceneError(f"a scene has at most {MAX_TRACKS} tracks, got {len(tracks)}: send the nearest")
    return tuple(tracks)


def tracks_of(agents: Iterable[Agent]) -> tuple[Track, ...]:
    """What a perfect tracker would tell now of a labelled scene's agents, the nearest `MAX_TRACKS`."""
    tracks = (track_of(agent) for agent in agents)
    return nearest_tracks(
        track for track in tracks if track is not None and math.hypot(track.x_m, track.y_m) < TRACK_REACH_M
    )


def track_of(agent: Agent) -> Track | None:
    """An agent's track now, or None where it is absent.

    Its speed comes from the last 0.2 s, or from the next ones where it has only just appeared.
    """
    now = HISTORY_STEPS - 1
    here = agent.poses[now]
    if not np.isfinite(here).all():
        return None
    other, sign = agent.poses[now - SPEED_STEPS], 1.0
    if not np.isfinite(other).all():
        other, sign = agent.poses[now + SPEED_STEPS], -1.0
    speed = 0.0
    if np.isfinite(other).all():
        moved = sign * (here[:2] - other[:2])
        along = math.cos(here[2]) * moved[0] + math.sin(here[2]) * moved[1]
        speed = float(along) / (SPEED_STEPS * STEP_S)
    heading = math.remainder(float(here[2]), 2 * math.pi)
    size = agent.length_m, agent.width_m
    return Track(float(here[0]), float(here[1]), heading, speed, *size, agent.kind, agent.lights)


def _rank(track: Track) -> float:
    return math.hypot(track.x_m, track.y_m) - (_AHEAD_BONUS_M if track.x_m > 0 else 0.0)
