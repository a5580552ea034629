"""VLA-World's responses (figure 5b): what is there, what will be, how that looks, and what to do about it.

Its axes are the paper's: (lateral, forward) in metres, what lies to the left is negative. `told_points` and
`read_trajectory` are the border to ours.
"""

from __future__ import annotations

from collections.abc import Sequence as Several
from typing import Final, cast

import numpy as np
import numpy.typing as npt

from model.driving.agents import AGENT_KINDS
from model.driving.paper_axes import from_paper_axes, to_paper_axes
from model.driving.scene import CAMERAS
from model.driving.trajectory import FloatArray
from model.formats.compounds import Number, Repeat
from model.formats.pieces import (
    Choice,
    Codes,
    Format,
    FormatError,
    Literal,
    Option,
    Piece,
    Record,
    Section,
    Sequence,
    Value,
)

PERCEPTION: Final = "perception"
PREDICTION: Final = "prediction"
VISUAL: Final = "visual"
THINK: Final = "think"
ACTION: Final = "action"
ANSWER: Final = "answer"

TIMES_S: Final = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
MAX_OBJECTS: Final = 8
MAX_NOTABLE: Final = 4
VISUAL_ALPHABET: Final = "visual"
VISUAL_CODES: Final = 98
"""Of a picture; `model.network.visual_codes` makes them."""
VISUAL_SIZE: Final = 1000
"""How many different codes there are."""
CAMERA_OPTIONS: Final = {camera: f"CAM_{camera.upper()}" for camera in CAMERAS}
"""How each of our cameras is written."""
DIRECTIONS: Final = ("Left", "Forward", "Right")
LATERAL: Final = ("MOVE FORWARD", "TURN LEFT", "TURN RIGHT")
SPEED: Final = (
    "A CONSTANT SPEED",
    "AN ACCELERATION",
    "A QUICK ACCELERATION",
    "A DECELERATION",
    "A QUICK DECELERATION",
    "A DECELERATION TO ZERO",
)
"""What table 3 counts as keep, accelerate (two), decelerate (two) and stop."""

_MOVING_M: Final = 0.2
"""Between waypoints: less says nothing of a heading, as waypoints are rounded to 0.1 m."""
_LATERAL_M: Final = Number(-50.0, 50.0, 0.1, name="lateral_m")
_FORWARD_M: Final = Number(-50.0, 120.0, 0.1, name="forward_m")
"""120 m in 3 s are 144 km/h."""
_SIZE_M: Final = (Number(0.1, 20.0, 0.1, name="width_m"), Number(0.1, 20.0, 0.1, name="length_m"))
_SHOULDER_M: Final = Number(0.0, 50.0, 0.1)
_ID: Final = Number(1, 99, 1, name="object_id")


def _kind() -> Choice:
    return Choice(tuple(map(Option, AGENT_KINDS)), name="kind")


def _pair(first: Piece, second: Piece, between: str = ", ") -> Sequence:
    return Sequence((Literal("("), first, Literal(between), second, Literal(")")))


def _tagged(section: str, *parts: Piece) -> Section:
    """A section between its tags."""
    return Section(section, Sequence((Literal(f"<{section}>"), *parts, Literal(f"</{section}>"))))


_OBJECT: Final = Record(
    Sequence(
        (
            Literal("object type: "),
            _kind(),
            Literal(", object id: "),
            _ID,
            Literal(", position: "),
            _pair(_LATERAL_M, _FORWARD_M),
            Literal(", size: "),
            _pair(*_SIZE_M),
        )
    )
)
_NOTABLE: Final = Record(
    Sequence(
        (
            Literal("Notable Objects: "),
            _kind(),
            Literal(" at "),
            _pair(_LATERAL_M, _FORWARD_M),
            Literal(". Potential Effects: within the safe zone of the ego-vehicle at "),
            Number(TIMES_S[0], TIMES_S[-1], 0.5, name="time_s"),
            Literal(" second."),
        )
    )
)
_POINT: Final = Record(_pair(_LATERAL_M, _FORWARD_M, ","), name="point")

VLA_WORLD_FORMAT: Final = Format(
    "vla_world",
    Sequence(
        (
            _tagged(
                PERCEPTION,
                Literal("Object detections: "),
                Repeat(_OBJECT, MAX_OBJECTS, between="; "),
                Literal(". Distance to the left shoulder is "),
                _SHOULDER_M,
                Literal("m and to the right shoulder is "),
                _SHOULDER_M,
                Literal("m."),
            ),
            _tagged(
                PREDICTION,
                Literal("Based on the past trajectory, the predicted trajectory 0.5s later is "),
                _POINT,
                Literal(", and the direction is "),
                Choice(tuple(map(Option, DIRECTIONS))),
                Literal("."),
            ),
            _tagged(
                VISUAL,
                Codes(VISUAL_ALPHABET, VISUAL_CODES, VISUAL_SIZE),
                Literal(" These are the visual tokens of "),
                Choice(tuple(map(Option, CAMERA_OPTIONS.values())), name="camera"),
                Literal(" image at the 0.5 second in the future."),
            ),
            _tagged(THINK, Repeat(_NOTABLE, MAX_NOTABLE, between=" ")),
            _tagged(
                ACTION,
                Record(
                    Sequence(
                        (
                            Choice(tuple(map(Option, LATERAL)), name="lateral"),
                            Literal(" WITH "),
                            Choice(tuple(map(Option, SPEED)), name="speed"),
                        )
                    )
                ),
            ),
            Section(
                ANSWER,
                Sequence(
                    (
                        Literal(f"<{ANSWER}>["),
                        Repeat(_POINT, len(TIMES_S), len(TIMES_S), between=", "),
                        Literal(f"]</{ANSWER}><|im_end|>"),
                    )
                ),
            ),
        )
    ),
)
"""perception, prediction, visual, think, action, answer"""


def told_points(xy_m: npt.ArrayLike) -> tuple[dict[str, float], ...]:
    """Points [n, 2] in the ego frame (ahead, left) as values of points, as near as they can be written.

    What lies beyond what can be written is moved to its border. Raises `FormatError` for what is not finite.
    """
    points = to_paper_axes(xy_m)
    if not np.isfinite(points).all():
        raise FormatError("points that are not finite cannot be written")
    return tuple(
        {"lateral_m": _nearest(_LATERAL_M, lateral), "forward_m": _nearest(_FORWARD_M, forward)}
        for lateral, forward in points
    )


def read_points(value: Value) -> npt.NDArray[np.float64]:
    """Points [n, 2] in the ego frame (ahead, left) of a value of points: `told_points` undone."""
    points = cast("Several[dict[str, float]]", value)
    return from_paper_axes([[each["lateral_m"], each["forward_m"]] for each in points])


def read_trajectory(value: Value) -> FloatArray:
    """The trajectory float32 [6, 4] of an answer's value; headings follow the way, in reverse gear too."""
    trajectory = np.zeros((len(TIMES_S), 4), np.float32)
    trajectory[:, :2] = read_points(value)
    before, heading = np.zeros(2), 0.0
    for pose in trajectory:
        ahead, left = (float(each) for each in pose[:2] - before)
        if np.hypot(ahead, left) >= _MOVING_M:
            backwards = ahead * np.cos(heading) + left * np.sin(heading) < 0
            heading = float(np.arctan2(-left, -ahead) if backwards else np.arctan2(left, ahead))
            before = pose[:2].astype(np.float64)
        pose[3] = heading
    return trajectory


def _nearest(number: Number, value: float) -> float:
    step = round((float(np.clip(value, number.low, number.high)) - number.low) / number.step)
    return float(number.texts[step])
