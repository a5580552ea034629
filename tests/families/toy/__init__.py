"""A family of its own words: four speeds, one for every 1.6 s, straight on; in doubt it says why first."""

from typing import Final

import numpy as np

from model.driving.plan import Plan
from model.driving.trajectory import FUTURE_STEPS, STEP_S, FloatArray
from model.families.family import Branch, Decode, Family, Lesson, Reading
from model.formats.compounds import Number, Repeat
from model.formats.pieces import Choice, Format, FreeText, Literal, Option, Section, Sequence, Values

_SPEEDS: Final = 4
_HELD_STEPS: Final = FUTURE_STEPS // _SPEEDS
_TOP_SPEED_MS: Final = 30
_STEP_MS: Final = 5

_GRID: Final = Repeat(Number(0, _TOP_SPEED_MS, _STEP_MS), _SPEEDS, _SPEEDS, between=" ")
_DRIVE: Final = Section("speeds", Sequence((Literal(" at "), _GRID, Literal(" m/s<|im_end|>"))))
_WHY: Final = Section("why", Sequence((Literal(" "), FreeText("\n", 12))))
_MOOD: Final = Choice((Option("Sure,", _DRIVE), Option("Hmm,", Sequence((_WHY, _DRIVE)))), name="mood")


def drive(speeds_ms: tuple[float, ...]) -> FloatArray:
    """Straight on at each of the speeds in turn: float32 [64, 4]."""
    trajectory = np.zeros((FUTURE_STEPS, 4), np.float32)
    trajectory[:, 0] = np.cumsum(np.repeat(speeds_ms, _HELD_STEPS) * STEP_S)
    return trajectory


def read(values: Values, decode: Decode) -> Reading:
    """The drive, and the reason for doubt. Nothing is decoded: there are no codes."""
    speeds, why = values["speeds"], values.get("why")
    assert isinstance(speeds, tuple)
    return Reading(
        trajectory=drive(tuple(float(str(speed)) for speed in speeds)),
        branch=str(values["mood"]),
        reflection=None if why is None else str(why),
    )


def teach(lesson: Lesson) -> Values:
    """Slower where the expert's plan says so."""
    speeds = (10.0, 10.0, 10.0, 10.0) if _keeps(lesson.plan) else (10.0, 5.0, 0.0, 0.0)
    return Values.of({"mood": "Sure,", "speeds": speeds})


def _keeps(plan: Plan) -> bool:
    return plan.word_at("longitudinal", 0) == "Keep Speed"


TOY: Final = Family(
    format=Format("toy", Section("mood", _MOOD)),
    task="Say how fast to drive.",
    trajectory="speeds",
    read=read,
    branch=Branch("mood", direct="Sure,", reflecting="Hmm,"),
    reflection="why",
    teach=teach,
)
