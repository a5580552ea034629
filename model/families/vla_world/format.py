"""VLA-World's responses (figure 5b): what is there, what will be, how that looks, and what to do about it.

Its axes are the paper's: (lateral, forward) in metres, what lies to the left is negative. `point_values` and
`read_trajectory` are the border to ours.
"""

from __future__ import annotations

from collections.abc import Sequence as Several
from dataclasses import replace
from typing import Final, cast, get_args
from typing import Literal as OneOf

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.agents import AGENT_KINDS
from looktwice.model.driving.paper_axes import from_paper_axes, to_paper_axes
from looktwice.model.driving.scene import CAMERAS
from looktwice.model.driving.trajectory import THREE_SECONDS_S, FloatArray
from looktwice.model.families.picture_codes import PICTURE, PICTURE_CODEBOOK, PICTURE_CODES
from looktwice.model.formats.compounds import Number, Repeat
from looktwice.model.formats.pieces import (
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
IMAGINE: Final = "imagine"
"""The section, and the choice in it, where a response imagines a picture or does not."""
VISUAL: Final = "visual"
THINK: Final = "think"
ACTION: Final = "action"
ANSWER: Final = "answer"

TIMES_S: Final = THREE_SECONDS_S
MAX_OBJECTS: Final = 8
MAX_NOTABLE: Final = 4
CAMERA_OPTIONS: Final = {camera: f"CAM_{camera.upper()}" for camera in CAMERAS}
"""How each of our cameras is written."""
CAMERA: Final = "camera"
"""The choice of the camera whose picture it is."""
IMAGINED: Final = f"<{VISUAL}>"
UNSEEN: Final = "\n"
"""The options of that choice; they begin with different tokens, so that one token decides it."""
Direction = OneOf["Left", "Forward", "Right"]
DIRECTIONS: Final[tuple[Direction, ...]] = get_args(Direction)
Lateral = OneOf["MOVE FORWARD", "TURN LEFT", "TURN RIGHT"]
LATERAL: Final[tuple[Lateral, ...]] = get_args(Lateral)
Speed = OneOf[
    "A CONSTANT SPEED",
    "AN ACCELERATION",
    "A QUICK ACCELERATION",
    "A DECELERATION",
    "A QUICK DECELERATION",
    "A DECELERATION TO ZERO",
]
SPEED: Final[tuple[Speed, ...]] = get_args(Speed)

_MOVING_M: Final = 0.2
"""Between waypoints: less says nothing of a heading, as waypoints are rounded to 0.1 m."""
LATERAL_M: Final = Number(-50.0, 50.0, 0.1, name="lateral_m")
FORWARD_M: Final = Number(-50.0, 120.0, 0.1, name="forward_m")
"""120 m in 3 s are 144 km/h."""
SIZE_M: Final = Number(0.1, 20.0, 0.1, name="size_m")
SHOULDER_M: Final = Number(0.0, 50.0, 0.1, name="shoulder_m")
"""Where numbers are tokens, these names are those of their alphabets."""
NEAR_S: Final = Number(TIMES_S[0], TIMES_S[-1], 0.5, name="time_s")
_THOUGHT: Final = (
    *("Notable Objects: ", " at "),
    *(". Potential Effects: within the safe zone of the ego-vehicle at ", " second."),
)
"""The words around kind, position and time of one thought."""
_ID: Final = Number(1, 99, 1, name="object_id")


def _kind() -> Choice:
    return Choice(tuple(map(Option, AGENT_KINDS)), name="kind")


def _pair(first: Piece, second: Piece, between: str = ", ") -> Sequence:
    return Sequence((Literal("("), first, Literal(between), second, Literal(")")))


def _tagged(section: str, *parts: Piece) -> Section:
    """A section between its tags."""
    return Section(section, Sequence((Literal(f"<{section}>"), *parts, Literal(f"</{section}>"))))


def points(count: int, *, tokens: bool = False) -> Repeat:
    """So many points, as `point_values` makes them, their numbers in digits or as one token each."""
    return Repeat(_point(tokens), count, count, between=", ")


def _spelt(number: Number, tokens: bool) -> Number:
    return replace(number, spelling=str(number.name)) if tokens else number


def _position(tokens: bool, between: str = ", ") -> Sequence:
    """Where something is, such as ``(-4.5, 3.2)``."""
    return _pair(_spelt(LATERAL_M, tokens), _spelt(FORWARD_M, tokens), between)


def _point(tokens: bool) -> Record:
    return Record(_position(tokens, ","), name="point")


def _objects(tokens: bool) -> Repeat:
    width, length = (replace(_spelt(SIZE_M, tokens), name=name) for name in ("width_m", "length_m"))
    told = (
        Literal("object type: "),
        _kind(),
        Literal(", object id: "),
        _ID,
        Literal(", position: "),
        _position(tokens),
        Literal(", size: "),
        _pair(width, length),
    )
    return Repeat(Record(Sequence(told)), MAX_OBJECTS, between="; ")


def _notable(tokens: bool) -> Repeat:
    """Who comes near, and when: the thoughts."""
    words = map(Literal, _THOUGHT)
    told = (next(words), _kind(), next(words), _position(tokens), next(words), NEAR_S, next(words))
    return Repeat(Record(Sequence(told)), MAX_NOTABLE, between=" ")


_PICTURE: Final = Section(
    VISUAL,
    Sequence(
        (
            # Each behind the one that is expected at its place, see `beside`.
            Codes(PICTURE, 2 * PICTURE_CODES, PICTURE_CODEBOOK),
            Literal(" These are the visual tokens of "),
            Choice(tuple(map(Option, CAMERA_OPTIONS.values())), name=CAMERA),
            Literal(f" image at the 0.5 second in the future.</{VISUAL}>"),
        )
    ),
)
_ACTION: Final = Record(
    Sequence(
        (
            Choice(tuple(map(Option, LATERAL)), name="lateral"),
            Literal(" WITH "),
            Choice(tuple(map(Option, SPEED)), name="speed"),
        )
    )
)


def _vla_world(*, tokens: bool) -> Format:
    perception = _tagged(
        PERCEPTION,
        Literal("Object detections: "),
        _objects(tokens),
        Literal(". Distance to the left shoulder is "),
        _spelt(SHOULDER_M, tokens),
        Literal("m and to the right shoulder is "),
        _spelt(SHOULDER_M, tokens),
        Literal("m."),
    )
    prediction = _tagged(
        PREDICTION,
        Literal("Based on the past trajectory, the predicted trajectory 0.5s later is "),
        _point(tokens),
        Literal(", and the direction is "),
        Choice(tuple(map(Option, DIRECTIONS))),
        Literal("."),
    )
    imagine = Section(IMAGINE, Choice((Option(IMAGINED, _PICTURE), Option(UNSEEN)), name=IMAGINE))
    answer = Section(
        ANSWER,
        Sequence(
            (
                Literal(f"<{ANSWER}>["),
                points(len(TIMES_S), tokens=tokens),
                Literal(f"]</{ANSWER}><|im_end|>"),
            )
        ),
    )
    think = _tagged(THINK, _notable(tokens))
    return Format(
        "vla_world", Sequence((perception, prediction, imagine, think, _tagged(ACTION, _ACTION), answer))
    )


VLA_WORLD_FORMAT: Final = _vla_world(tokens=False)
"""perception, prediction, imagine { visual or none }, think, action, answer; for public checkpoints: numbers
in digits"""
VLA_WORLD_TOKENS: Final = _vla_world(tokens=True)
"""For small checkpoints: metres as one token each."""


def thoughts_text(value: Value) -> str:
    """The text of the thoughts of a value of notable objects."""
    start, at, effects, end = _THOUGHT
    return " ".join(
        f"{start}{each['kind']}{at}({each['lateral_m']:.1f}, {each['forward_m']:.1f})"
        f"{effects}{each['time_s']:.1f}{end}"
        for each in cast("Several[dict[str, float]]", value)
    )


def point_values(xy_m: npt.ArrayLike) -> tuple[dict[str, float], ...]:
    """Points [n, 2] in the ego frame (ahead, left) as values of points, as near as they can be written.

    What lies beyond what can be written is moved to its border. Raises `FormatError` for what is not finite.
    """
    told = to_paper_axes(xy_m)
    if not np.isfinite(told).all():
        raise FormatError("points that are not finite cannot be written")
    return tuple(
        {"lateral_m": LATERAL_M.nearest(lateral), "forward_m": FORWARD_M.nearest(forward)}
        for lateral, forward in told.tolist()
    )


def read_points(value: Value) -> npt.NDArray[np.float64]:
    """Points [n, 2] in the ego frame (ahead, left) of a value of points: `point_values` undone."""
    told = cast("Several[dict[str, float]]", value)
    return from_paper_axes([[each["lateral_m"], each["forward_m"]] for each in told])


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
