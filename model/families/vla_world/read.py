"""What a response of VLA-World says."""

from __future__ import annotations

from model.families.family import Decode, Reading
from model.families.vla_world.format import ANSWER, THINK, read_trajectory, told_thoughts
from model.formats.pieces import Values


def read(values: Values, decode: Decode) -> Reading:
    """Its waypoints, and its thoughts where it has any. Nothing is decoded: a trajectory has no codes."""
    return Reading(read_trajectory(values[ANSWER]), reflection=told_thoughts(values[THINK]) or None)
