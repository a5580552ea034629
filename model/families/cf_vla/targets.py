"""What a labelled scene teaches CF-VLA, and how much each of its sections weighs."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from looktwice.model.families.cf_vla.format import (
    ACTION,
    BRANCH,
    PLAN,
    REFLECTION,
    REVISED_PLAN,
    THINKING,
    TRAJECTORY,
)
from looktwice.model.families.family import Lesson
from looktwice.model.formats.pieces import Values


def _weights(words: float, trajectory: float) -> Mapping[str, float]:
    of_words = dict.fromkeys((PLAN, BRANCH, REFLECTION, REVISED_PLAN), words)
    return MappingProxyType({**of_words, TRAJECTORY: trajectory})


PAPER_WEIGHTS: Final = _weights(10.0, 1.0)
"""w_act : w_meta : w_CF = 1 : 10 : 10 (CF-VLA section 7); the branch word counts as a meta-action token."""

NANO_WEIGHTS: Final = _weights(3.0, 10.0)
"""A model from scratch learns trajectories too, which the paper's brings along. The tenths of a plan's times
are next to unknowable: with the paper's weights their noise drowns what codes teach."""

SKETCHED_WEIGHTS: Final[Mapping[str, float]] = MappingProxyType({**NANO_WEIGHTS, BRANCH: 60.0})
"""What a critic says of a sketch stands in one token of the prompt, and the branch alone needs it: among a
hundred words that weigh as much, it is hardly ever read."""

CODE_WEIGHTS: Final = _weights(0.0, 10.0)
"""Codes alone: beside what a model learns from its own draws, which decide about words."""


def teach(lesson: Lesson) -> Values:
    """The response that an expert would give, behind the plan of a reflection where there is one."""
    reflection, trajectory = lesson.reflection, lesson.codes
    if reflection is None or not reflection.thinking:
        plan = lesson.plan if reflection is None else reflection.first_plan
        return Values.of({PLAN: plan, BRANCH: ACTION, TRAJECTORY: trajectory})
    return Values.of(
        {
            PLAN: reflection.first_plan,
            BRANCH: THINKING,
            REFLECTION: reflection.thinking,
            REVISED_PLAN: reflection.revised_plan or lesson.plan,
            TRAJECTORY: trajectory,
        }
    )
