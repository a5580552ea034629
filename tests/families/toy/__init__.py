"""A family of its own words: four speeds, one a second, straight on; in doubt it says why first."""

from typing import Final

import numpy as np

from looktwice.model.driving.trajectory import FloatArray, present_speed
from looktwice.model.families.family import Branch, Decode, Family, Lesson, Reading, Situation, TextInputs
from looktwice.model.formats.compounds import Number, Repeat
from looktwice.model.formats.pieces import (
    Choice,
    Format,
    FreeText,
    Literal,
    Option,
    Section,
    Sequence,
    Values,
)

_TIMES_S: Final = (1.0, 2.0, 3.0, 4.0)
_TOP_SPEED_MS: Final = 30
_STEP_MS: Final = 5

_GRID: Final = Repeat(Number(0, _TOP_SPEED_MS, _STEP_MS), len(_TIMES_S), len(_TIMES_S), between=" ")
_DRIVE: Final = Section("speeds", Sequence((Literal(" at "), _GRID, Literal(" m/s<|im_end|>"))))
_WHY: Final = Section("why", Sequence((Literal(" "), FreeText("\n", 12))))
_MOOD: Final = Choice((Option("Sure,", _DRIVE), Option("Hmm,", Sequence((_WHY, _DRIVE)))), name="mood")


def drive(speeds_ms: tuple[float, ...]) -> FloatArray:
    """Straight on at each of the speeds in turn, where that leads at `_TIMES_S`: float32 [4, 4]."""
    trajectory = np.zeros((len(_TIMES_S), 4), np.float32)
    trajectory[:, 0] = np.cumsum(speeds_ms)
    return trajectory


def read(values: Values, decode: Decode) -> Reading:
    """The drive. Nothing is decoded: there are no codes."""
    speeds = values["speeds"]
    assert isinstance(speeds, tuple)
    return Reading(drive(tuple(float(str(speed)) for speed in speeds)), branch=str(values["mood"]))


def teach(lesson: Lesson) -> Values:
    """The expert's speeds, as near as they can be said."""
    metres = lesson.future[[round(10 * time_s) - 1 for time_s in _TIMES_S], 0]
    wanted = np.diff(metres, prepend=0.0).clip(0, _TOP_SPEED_MS)
    return Values.of({"mood": "Sure,", "speeds": tuple((_STEP_MS * np.rint(wanted / _STEP_MS)).tolist())})


def describe(situation: Situation) -> Values:
    """How fast the ego is, and where the route leads at its end."""
    route = situation.route
    side = "unknown" if route is None else "left" if route[-1, 1] > 0 else "right"
    speed_ms = round(min(max(0.0, present_speed(situation.history)), _TOP_SPEED_MS))
    return Values.of({"speed": float(speed_ms), "goal": side})


_NOW: Final = Sequence((Literal("now at "), Number(0, _TOP_SPEED_MS, 1), Literal(" m/s,")))
_SIDE: Final = Choice((Option("left"), Option("right"), Option("unknown")))
_GOAL: Final = Sequence((Literal(" goal "), _SIDE, Literal("\n")))
_INPUTS: Final = Format("toy inputs", Sequence((Section("speed", _NOW), Section("goal", _GOAL))))

TOY: Final = Family(
    format=Format("toy", Section("mood", _MOOD)),
    task="Say how fast to drive.",
    trajectory="speeds",
    read=read,
    times_s=_TIMES_S,
    inputs=TextInputs(_INPUTS, describe),
    branch=Branch("mood", direct="Sure,", reflecting="Hmm,"),
    reflection="why",
    teach=teach,
)
