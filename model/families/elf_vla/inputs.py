"""What ELF-VLA's prompts say of a scene (supplement, figures 6 and 7), in words and numbers."""

from __future__ import annotations

from typing import Final, Literal, get_args

from looktwice.model.driving.pdm.feedback import BEGIN, END
from looktwice.model.driving.short_term import mission_goal
from looktwice.model.driving.trajectory import FloatArray, present_acceleration, present_speed
from looktwice.model.families.elf_vla.format import TIMES_S, pose_values, poses
from looktwice.model.families.family import FamilyError, Situation, TextInputs
from looktwice.model.formats import pieces
from looktwice.model.formats.compounds import Number
from looktwice.model.formats.pieces import Choice, Format, FreeText, Option, Section, Sequence, Value, Values

Command = Literal["left", "straight", "right", "unknown"]

MAX_FEEDBACK_TOKENS: Final = 1024
"""Room for the five sections of figure 8b, in the vocabularies of small checkpoints as well."""

_SPEED_MS: Final = Number(-20.0, 60.0, 0.1)
_ACCELERATION_MS2: Final = Number(-15.0, 15.0, 0.1)
_PLAIN: Final = str.maketrans("\u00b2\u00b3", "23")
"""Squares and cubes of units, which small vocabularies do not have."""
_PAST_STEPS: Final = (0, 5, 10)
"""Rows of a history 1.5 s, 1 s and 0.5 s ago. The last row, now, is where the ego frame begins."""


def command_of(route: FloatArray | None) -> Command:
    """Which way a route [20, 2] leads next, as navigation says it."""
    if route is None:
        return "unknown"
    goal = mission_goal(route)
    return "straight" if goal == "forward" else goal


def _base(situation: Situation) -> dict[str, Value]:
    history = situation.history
    return {
        "command": command_of(situation.route),
        "velocity": _SPEED_MS.nearest(present_speed(history)),
        "acceleration": _ACCELERATION_MS2.nearest(present_acceleration(history)),
        "past": pose_values(history[list(_PAST_STEPS)]),
    }


def describe(situation: Situation) -> Values:
    """The base inputs."""
    return Values.of(_base(situation))


def describe_attempt(situation: Situation) -> Values:
    """The base inputs, and the attempt; raises `FamilyError` without one."""
    attempt = situation.attempt
    if attempt is None:
        raise FamilyError("there is no attempt to be refined: give a draft and feedback on it")
    draft, feedback = pose_values(attempt.trajectory), _told(attempt.feedback)
    return Values.of(_base(situation) | {"draft": draft, "feedback": feedback})


def _told(feedback: str) -> str:
    """Feedback without the tags that sections bring and the prompt sets, and units in plain letters."""
    text = feedback.strip()
    if text.startswith(BEGIN) and text.endswith(END):
        text = text[len(BEGIN) : -len(END)].strip()
    return text.translate(_PLAIN)


def _line(name: str, start: str, piece: pieces.Piece, end: str = "\n") -> Section:
    return Section(name, Sequence((pieces.Literal(start), piece, pieces.Literal(end))))


_BASE: Final = (
    _line("command", "Command: ", Choice(tuple(map(Option, get_args(Command))))),
    _line("velocity", "Velocity: ", _SPEED_MS, " m/s\n"),
    _line("acceleration", "Acceleration: ", _ACCELERATION_MS2, " m/s2\n"),
    _line("past", "Historical trajectory: ", poses(len(_PAST_STEPS))),
)
_ATTEMPT: Final = (
    _line("draft", "Draft: ", poses(len(TIMES_S))),
    _line("feedback", BEGIN, FreeText(END, MAX_FEEDBACK_TOKENS, multiline=True)),
)

BASE: Final = TextInputs(Format("elf_vla inputs", Sequence(_BASE)), describe)
WITH_ATTEMPT: Final = TextInputs(
    Format("elf_vla_refine inputs", Sequence((*_BASE, *_ATTEMPT))), describe_attempt
)
