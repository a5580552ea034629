"""The response formats of CF-VLA (sections 3.1 and 8) and of its traj-only baseline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from model.driving.phrases import ReflectionLanguage
from model.formats.phrases import Reflection
from model.formats.pieces import (
    ACTION,
    BRANCH,
    CODES,
    THINKING,
    TRAJECTORY,
    Choice,
    Codes,
    Format,
    FreeText,
    Literal,
    Option,
    Piece,
    Section,
    Sequence,
)
from model.formats.plan_tracks import FIRST_PLAN, REFLECTION, PlanTracks, RevisedPlan

MAX_THINKING_TOKENS: Final = 160
"""Teachers write at most 80 words (CF-VLA section 8); two tokens a word leave room to spare."""

_TRAJECTORY: Final = Sequence(
    (Literal("\n<|traj_future_start|>"), Codes(TRAJECTORY, CODES), Literal("<|traj_future_end|><|im_end|>"))
)
_PLAN_START: Final = "Meta Actions:\n"


def _cf_vla(thinking: Piece, revised: Piece) -> Format:
    reflection = Sequence(
        (
            Section(REFLECTION, Sequence((Literal("\n"), thinking))),
            Section("revised_plan", Sequence((Literal(_PLAN_START), revised))),
            Section("trajectory", Sequence((Literal(ACTION), _TRAJECTORY))),
        )
    )
    direct = Section("trajectory", _TRAJECTORY)
    branch = Choice((Option(ACTION, direct), Option(THINKING, reflection)), name=BRANCH)
    plan = Section(FIRST_PLAN, Sequence((Literal(_PLAN_START), PlanTracks())))
    return Format("cf_vla", Sequence((plan, Section(BRANCH, branch))))


CF_VLA: Final = _cf_vla(FreeText("\n", MAX_THINKING_TOKENS), PlanTracks())
"""plan, branch { Action: trajectory | Thinking: free text, revised plan, Action: trajectory }"""

CF_VLA_PHRASES: Final = _cf_vla(Sequence((Reflection(), Literal("\n"))), RevisedPlan())
"""The same with a reflection in phrases, and a revised plan that changes as these say."""

TRAJ_ONLY: Final = Format("traj_only", Section("trajectory", Sequence((Literal(ACTION), _TRAJECTORY))))
"""The trajectory at once, without a plan."""

_FORMATS: Final[Mapping[ReflectionLanguage, Mapping[str, Format]]] = {
    "free_text": {format.name: format for format in (CF_VLA, TRAJ_ONLY)},
    "phrases": {format.name: format for format in (CF_VLA_PHRASES, TRAJ_ONLY)},
}


def formats_of(reflection: ReflectionLanguage) -> Mapping[str, Format]:
    """The response formats, by the name that requests give, of models whose reflections are so written."""
    return _FORMATS[reflection]
