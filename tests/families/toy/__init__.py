"""A family of its own words: four speeds and four turns, one a second; in doubt it says why first.

Before them it says how far it keeps from others. That is a number of an alphabet of its own, and turns are
codes of another one: `turned` and `turns_of` are its codec.
"""

from typing import Final

import numpy as np

from looktwice.model.driving.trajectory import FloatArray, present_speed
from looktwice.model.families.family import Branch, Decode, Family, Lesson, Reading, Situation, TextInputs
from looktwice.model.formats.compounds import Number, Repeat
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Format,
    FreeText,
    Literal,
    Option,
    Section,
    Sequence,
    Value,
    Values,
)

_TIMES_S: Final = (1.0, 2.0, 3.0, 4.0)
_TOP_SPEED_MS: Final = 30
_STEP_MS: Final = 5
_TURNS_RAD: Final = np.array([-0.2, 0.0, 0.2], np.float32)
"""What each code of a turn stands for, from right to left."""
_GAP_S: Final = 2.0

_METRES: Final = Number(0, 60, 5, "toy_gap_m")
_GAP: Final = Section("gap", Sequence((Literal(" keep "), _METRES, Literal(" m,"))))
_CODES: Final = Codes("toy_turn", len(_TIMES_S), size=len(_TURNS_RAD), ordered=True)
_TURNS: Final = Section("turns", Sequence((Literal(" turn "), _CODES, Literal(","))))
_GRID: Final = Repeat(Number(0, _TOP_SPEED_MS, _STEP_MS), len(_TIMES_S), len(_TIMES_S), between=" ")
_SPEEDS: Final = Section("speeds", Sequence((Literal(" at "), _GRID, Literal(" m/s<|im_end|>"))))
_DRIVE: Final = Sequence((_GAP, _TURNS, _SPEEDS))
_WHY: Final = Section("why", Sequence((Literal(" "), FreeText("\n", 12))))
_MOOD: Final = Choice((Option("Sure,", _DRIVE), Option("Hmm,", Sequence((_WHY, _DRIVE)))), name="mood")


def turned(codes: tuple[int, ...]) -> FloatArray:
    """The heading at `_TIMES_S` of codes of turns, in rad: float32 [4]."""
    headings_rad: FloatArray = np.cumsum(_TURNS_RAD[list(codes)])
    return headings_rad


def turns_of(headings_rad: FloatArray) -> tuple[int, ...]:
    """The codes of turns that come nearest to headings at `_TIMES_S`."""
    codes, reached = list[int](), 0.0
    for heading in headings_rad:
        codes.append(int(np.abs(_TURNS_RAD - (heading - reached)).argmin()))
        reached += float(_TURNS_RAD[codes[-1]])
    return tuple(codes)


def drive(speeds_ms: tuple[float, ...], turns: tuple[int, ...]) -> FloatArray:
    """Where each of the speeds and turns leads in its second, at `_TIMES_S`: float32 [4, 4]."""
    trajectory = np.zeros((len(_TIMES_S), 4), np.float32)
    trajectory[:, 3] = turned(turns)
    trajectory[:, 0] = np.cumsum(speeds_ms * np.cos(trajectory[:, 3]))
    trajectory[:, 1] = np.cumsum(speeds_ms * np.sin(trajectory[:, 3]))
    return trajectory


def _numbers(value: Value) -> list[float]:
    assert isinstance(value, tuple)
    return [float(str(number)) for number in value]


def read(values: Values, decode: Decode) -> Reading:
    """The drive. The checkpoint's codec has nothing to decode: the codes are the family's own."""
    turns = tuple(map(int, _numbers(values["turns"])))
    return Reading(drive(tuple(_numbers(values["speeds"])), turns), branch=str(values["mood"]))


def teach(lesson: Lesson) -> Values:
    """The expert's speeds and turns, as near as they can be said, and the gap to keep at the first speed."""
    poses = lesson.future[[round(10 * time_s) - 1 for time_s in _TIMES_S]]
    wanted = np.diff(poses[:, 0], prepend=0.0).clip(0, _TOP_SPEED_MS)
    speeds_ms = tuple((_STEP_MS * np.rint(wanted / _STEP_MS)).tolist())
    gap_m = _METRES.nearest(_GAP_S * speeds_ms[0])
    return Values.of({"mood": "Sure,", "gap": gap_m, "turns": turns_of(poses[:, 3]), "speeds": speeds_ms})


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
