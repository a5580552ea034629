"""What VLA-World's prompts say of a scene (figure 5b), in words and numbers.

Points are (lateral, forward), and left is negative. A turn to the left is positive, as in nuScenes. The
paper's history is 2 s long, ours 1.5 s.
"""

from __future__ import annotations

from typing import Final

from looktwice.model.driving.short_term import mission_goal
from looktwice.model.driving.trajectory import STEP_S, FloatArray, present_acceleration, present_speed
from looktwice.model.families.family import Situation, TextInputs
from looktwice.model.families.vla_world.format import CAMERA_OPTIONS, point_values, points
from looktwice.model.formats.compounds import Number
from looktwice.model.formats.pieces import (
    Choice,
    Format,
    Literal,
    Option,
    Piece,
    Section,
    Sequence,
    Values,
)

GOALS: Final = ("LEFT", "FORWARD", "RIGHT", "UNKNOWN")
"""The last one where there is no route."""

ANY_CAMERA: Final = "ANY"
"""Where nobody asks for a camera: the model chooses whether it imagines, and which one."""
_SPEED_MS: Final = Number(-20.0, 60.0, 0.1)
_YAW_RATE_RADS: Final = Number(-2.0, 2.0, 0.01)
_ACCELERATION_MS2: Final = Number(-15.0, 15.0, 0.1)
_PAST_STEPS: Final = (0, 5, 10)
"""Rows of a history 1.5 s, 1 s and 0.5 s ago."""


def goal_of(route: FloatArray | None) -> str:
    """Which way a route [20, 2] leads next, one of `GOALS`."""
    return "UNKNOWN" if route is None else mission_goal(route).upper()


def describe(situation: Situation) -> Values:
    """Ego status, past trajectory, mission goal and the camera that is asked for."""
    history = situation.history
    half_a_second_ago = _PAST_STEPS[-1]
    turned_rad = float(history[-1, 3] - history[half_a_second_ago, 3])
    yaw_rate = turned_rad / (STEP_S * (len(history) - 1 - half_a_second_ago))
    return Values.of(
        {
            "velocity": _SPEED_MS.nearest(present_speed(history)),
            "yaw_rate": _YAW_RATE_RADS.nearest(yaw_rate),
            "acceleration": _ACCELERATION_MS2.nearest(present_acceleration(history)),
            "past": point_values(history[list(_PAST_STEPS), :2]),
            "goal": goal_of(situation.route),
            "camera": ANY_CAMERA if situation.camera is None else CAMERA_OPTIONS[situation.camera],
        }
    )


def _line(name: str, start: str, piece: Piece, end: str) -> Section:
    return Section(name, Sequence((Literal(start), piece, Literal(end))))


_CAMERAS: Final = (*CAMERA_OPTIONS.values(), ANY_CAMERA)
INPUTS: Final = TextInputs(
    Format(
        "vla_world inputs",
        Sequence(
            (
                _line("velocity", "Velocity: ", _SPEED_MS, " m/s "),
                _line("yaw_rate", "Heading Angular Velocity: ", _YAW_RATE_RADS, " rad/s "),
                _line("acceleration", "Acceleration: ", _ACCELERATION_MS2, " m/s2\n"),
                _line("past", "Historical Trajectory: [", points(len(_PAST_STEPS)), "]\n"),
                _line("goal", "Mission Goal: ", Choice(tuple(map(Option, GOALS))), "\n"),
                _line("camera", "Camera: ", Choice(tuple(map(Option, _CAMERAS))), "\n"),
            )
        ),
    ),
    describe,
)
