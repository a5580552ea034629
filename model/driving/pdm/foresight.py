"""The world ahead as it can be foreseen on the road: tracked objects go on at constant velocity.

It is made of what a planner is told. So no feedback and no score that is made in it can hold ground truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from looktwice.model.driving.agents import ROAD_USERS
from looktwice.model.driving.pdm.labelled import EGO, past_states, route_line
from looktwice.model.driving.pdm.world import LONG_STEPS, STEP_S, TrackedBox, World
from looktwice.model.driving.tracks import Track
from looktwice.model.driving.trajectory import FloatArray

Foresight = Literal["constant_velocity"]
CONSTANT_VELOCITY: Final[Foresight] = "constant_velocity"
"""How a future is foreseen: all objects go on along their headings, as fast as now."""


def world_ahead(history: FloatArray, route: FloatArray | None, tracks: Sequence[Track]) -> World:
    """The world around the ego, as far as it can be foreseen.

    The ego is the car of our scenes, and poses are those of its centre. The route is the centre line. Lanes,
    the road's edges and lights are not known, so what needs them is not scored. Lanes would decide whose
    fault a touch beside the ego is: here it is the ego's.

    Args:
        history: [16, 4], the ego's way up to now.
        route: [20, 2]; None where it is unknown.
        tracks: the objects around. The first is called ``0`` in failures and facts, and so on.
    """
    past = past_states(history)
    return World(
        ego=past[-1],
        vehicle=EGO,
        tracks=tuple(_box(str(number), track) for number, track in enumerate(tracks)),
        centreline=route_line(route),
        past=past[:-1],
        careful=True,
    )


def _box(track_id: str, track: Track) -> TrackedBox:
    gone_m = track.speed_ms * STEP_S * np.arange(LONG_STEPS + 1)
    poses = np.full((LONG_STEPS + 1, 3), track.heading_rad)
    poses[:, 0] = track.x_m + gone_m * np.cos(track.heading_rad)
    poses[:, 1] = track.y_m + gone_m * np.sin(track.heading_rad)
    is_agent = track.kind in ROAD_USERS
    return TrackedBox(
        track_id, is_agent, track.length_m, track.width_m, poses, abs(track.speed_ms), track.kind
    )
