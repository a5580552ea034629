"""CF-VLA's responses (sections 3.1 and 8), with reflections in free text or in phrases."""

from __future__ import annotations

from typing import Final

from looktwice.model.families.trajectory_codes import TRAJECTORY_CODES
from looktwice.model.formats.phrase_pieces import ReflectionPhrases
from looktwice.model.formats.pieces import Choice, Format, FreeText, Literal, Option, Piece, Section, Sequence
from looktwice.model.formats.plan_tracks import PlanTracks, RevisedPlan

PLAN: Final = "plan"
BRANCH: Final = "branch"
"""The section where a response decides to act or to think, and the choice in it."""
REFLECTION: Final = "thinking"
REVISED_PLAN: Final = "revised_plan"
TRAJECTORY: Final = "trajectory"

ACTION: Final = "Action:"
THINKING: Final = "Thinking:"
"""The options of the branch; a trajectory behind a reflection begins with the word for acting, too."""

MAX_THINKING_TOKENS: Final = 160
"""Teachers write at most 80 words (CF-VLA section 8); two tokens a word leave room to spare."""

PLAN_START: Final = "Meta Actions:\n"
"""What both plans begin with."""


def _cf_vla(thinking: Piece, revised: Piece) -> Format:
    reflection = Sequence(
        (
            Section(REFLECTION, Sequence((Literal("\n"), thinking))),
            Section(REVISED_PLAN, Sequence((Literal(PLAN_START), revised))),
            Section(TRAJECTORY, Sequence((Literal(ACTION), TRAJECTORY_CODES))),
        )
    )
    direct = Section(TRAJECTORY, TRAJECTORY_CODES)
    branch = Choice((Option(ACTION, direct), Option(THINKING, reflection)), name=BRANCH)
    plan = Section(PLAN, Sequence((Literal(PLAN_START), PlanTracks())))
    return Format("cf_vla", Sequence((plan, Section(BRANCH, branch))))


FREE_TEXT: Final = _cf_vla(FreeText("\n", MAX_THINKING_TOKENS), PlanTracks())
"""plan, branch { Action: trajectory | Thinking: free text, revised plan, Action: trajectory }"""

PHRASES: Final = _cf_vla(
    Sequence((ReflectionPhrases(PLAN), Literal("\n"))), RevisedPlan(first_plan=PLAN, reflection=REFLECTION)
)
"""The same with a reflection in phrases, and a revised plan that changes as these say."""
