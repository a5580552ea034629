"""The response formats of CF-VLA (sections 3.1 and 8) and of its traj-only baseline."""

from __future__ import annotations

from typing import Final

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
    Section,
    Sequence,
)
from model.formats.plan_tracks import PlanTracks

MAX_THINKING_TOKENS: Final = 160
"""Teachers write at most 80 words (CF-VLA section 8); two tokens a word leave room to spare."""

_TRAJECTORY: Final = Sequence(
    (Literal("\n<|traj_future_start|>"), Codes(TRAJECTORY, CODES), Literal("<|traj_future_end|><|im_end|>"))
)
_PLAN: Final = Sequence((Literal("Meta Actions:\n"), PlanTracks()))
_REFLECTION: Final = Sequence(
    (
        Section("thinking", Sequence((Literal("\n"), FreeText("\n", MAX_THINKING_TOKENS)))),
        Section("revised_plan", _PLAN),
        Section("trajectory", Sequence((Literal(ACTION), _TRAJECTORY))),
    )
)

CF_VLA: Final = Format(
    "cf_vla",
    Sequence(
        (
            Section("plan", _PLAN),
            Section(
                BRANCH,
                Choice(
                    (Option(ACTION, Section("trajectory", _TRAJECTORY)), Option(THINKING, _REFLECTION)),
                    name=BRANCH,
                ),
            ),
        )
    ),
)
"""plan, branch { Action: trajectory | Thinking: free text, revised plan, Action: trajectory }"""

TRAJ_ONLY: Final = Format("traj_only", Section("trajectory", Sequence((Literal(ACTION), _TRAJECTORY))))
"""The trajectory at once, without a plan."""

FORMATS: Final = {format.name: format for format in (CF_VLA, TRAJ_ONLY)}
"""Every known response format by the name that requests give."""
