"""What a labelled scene teaches ELF-VLA, and how much each of its sections weighs."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from looktwice.model.driving.trajectory import TEN_HZ_S, at_times
from looktwice.model.families.elf_vla.format import ANSWER, THINK, TIMES_S, pose_values
from looktwice.model.families.family import FamilyError, Lesson
from looktwice.model.formats.pieces import Values

WEIGHTS: Final[Mapping[str, float]] = MappingProxyType({THINK: 1.0, ANSWER: 1.0})
"""The paper weighs all tokens of a response alike."""
QUESTION_WEIGHTS: Final[Mapping[str, float]] = MappingProxyType({THINK: 1.0, ANSWER: 0.0})
"""Of pre-training on questions and answers (section 7.1): each sentence of the thoughts asks one question,
such as who is ahead in the own lane, and answers it from the labels."""


def teach(lesson: Lesson) -> Values:
    """The expert's thoughts and poses, or those of an attempt that was right.

    The supplement does not say what is taught behind feedback on a right answer; the answer itself is ours.

    Raises:
        FamilyError: the scene says nothing to think of.
    """
    tried = lesson.attempt
    if tried is not None and tried.correct:
        return Values.of({THINK: tried.thinking, ANSWER: pose_values(tried.attempt.trajectory)})
    if lesson.thoughts is None:
        raise FamilyError("no thoughts: the scene lacks agents, lanes or road, or its expert is on no lane")
    poses = at_times(lesson.future, TEN_HZ_S, TIMES_S)
    return Values.of({THINK: str(lesson.thoughts), ANSWER: pose_values(poses)})
