"""Tracks as numbers for networks: where each stands and moves, seen from the ego and along the route."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from looktwice.model.driving.route_frame import RouteFrame
from looktwice.model.driving.tracks import MAX_TRACKS, Track
from looktwice.model.driving.trajectory import FloatArray

TRACK_FEATURES: Final = (
    "present",
    "x",
    "y",
    "cos_heading",
    "sin_heading",
    "speed",
    "on_route",
    "along",
    "left",
    "speed_along",
    "speed_left",
    "pedestrian",
    "obstacle",
    "hazard",
    "brake",
    "indicator",
    "length",
    "width",
    "standing",
)
MIRRORED: Final = tuple(
    TRACK_FEATURES.index(name) for name in ("y", "sin_heading", "left", "speed_left", "indicator")
)
"""Columns that change sign where left and right are swapped."""
_OF_ROUTE: Final = slice(TRACK_FEATURES.index("on_route"), TRACK_FEATURES.index("speed_left") + 1)
_STANDING_MS: Final = 0.3
X_SCALE_M: Final = 30.0
Y_SCALE_M: Final = 5.0
TRACK_SPEED_SCALE_MS: Final = 10.0


def track_features(tracks: Sequence[Track], route: FloatArray | None) -> FloatArray:
    """float32 [16, len(TRACK_FEATURES)], rows of nobody zero; lengths and speeds scaled to order one.

    The columns from ``along`` to ``speed_left`` are relative to the ``route`` [20, 2]; zero without one.
    """
    features = np.zeros((MAX_TRACKS, len(TRACK_FEATURES)), np.float32)
    if not tracks:
        return features
    xy = np.array([(track.x_m, track.y_m) for track in tracks])
    frame = None if route is None else RouteFrame(route)
    places = np.zeros((len(tracks), 2)) if frame is None else frame.places(xy)
    headings = np.zeros(len(tracks)) if frame is None else frame.headings(xy)
    for row, track in enumerate(tracks):
        turn = track.heading_rad - headings[row]
        hazard = {"left", "right"} <= track.lights
        indicator = 0 if hazard else ("left" in track.lights) - ("right" in track.lights)
        features[row] = (
            1.0,
            track.x_m / X_SCALE_M,
            track.y_m / Y_SCALE_M,
            math.cos(track.heading_rad),
            math.sin(track.heading_rad),
            track.speed_ms / TRACK_SPEED_SCALE_MS,
            frame is not None,
            places[row, 0] / 30,
            places[row, 1] / 3,
            0.0 if frame is None else track.speed_ms * math.cos(turn) / 10,
            0.0 if frame is None else track.speed_ms * math.sin(turn) / 2,
            track.kind == "pedestrian",
            track.kind in ("cone", "barrier"),
            hazard,
            "brake" in track.lights,
            indicator,
            track.length_m / 4,
            track.width_m / 2,
            abs(track.speed_ms) < _STANDING_MS,
        )
    return features


def moving(features: FloatArray) -> FloatArray:
    """Those that `track_features` tells of, [n, 5]: x_m, y_m, cosine and sine of their heading, speed_ms."""
    scales = {
        "x": X_SCALE_M,
        "y": Y_SCALE_M,
        "cos_heading": 1.0,
        "sin_heading": 1.0,
        "speed": TRACK_SPEED_SCALE_MS,
    }
    present = features[:, TRACK_FEATURES.index("present")] > 0
    return np.stack(
        [scale * features[present, TRACK_FEATURES.index(name)] for name, scale in scales.items()], axis=1
    )


def without_route(features: FloatArray) -> FloatArray:
    """A copy of what `track_features` gave for a route, as it gives it for none."""
    copied = features.copy()
    copied[..., _OF_ROUTE] = 0.0
    return copied
