"""What the fixture of NAVSIM's own scores holds."""

from __future__ import annotations

from looktwice.model.driving.pdm.scoring import (
    COLLISIONS,
    COMFORT,
    DIRECTION,
    DRIVABLE,
    LANE_KEEPING,
    LIGHTS,
    PROGRESS,
    TIME_TO_COLLISION,
)

WORLDS = 1000
SCORE = "score"
NAMES = (
    *(COLLISIONS, DRIVABLE, DIRECTION, LIGHTS, PROGRESS, TIME_TO_COLLISION, LANE_KEEPING, COMFORT),
    SCORE,
)
"""Columns of the scores; the last is NAVSIM's score without extended comfort."""
EXTENDED = "extended"
STATE_STEPS = (20, 40)
"""Steps whose states are kept of every plan."""
FULL_STATES = 12
"""Worlds whose states are kept at every step."""
