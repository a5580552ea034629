"""A response whose reflection is made of phrases, so that its words and numbers can be read back."""

from __future__ import annotations

from typing import Final

from looktwice.model.families.cf_vla.format import ACTION, BRANCH, THINKING
from looktwice.model.families.trajectory_codes import CODES, TRAJECTORY
from looktwice.model.formats.compounds import Number, Repeat
from looktwice.model.formats.pieces import (
    Choice,
    Codes,
    Format,
    Literal,
    Maybe,
    Option,
    Record,
    Section,
    Sequence,
)
from looktwice.model.formats.plan_tracks import PlanTracks


def words(name: str, *texts: str) -> Choice:
    """A named choice without anything that follows."""
    return Choice(tuple(Option(f" {text}") for text in texts), name)


_CUE: Final = Record(
    Sequence(
        (
            Literal("A"),
            words("object", "car", "lorry", "pedestrian", "traffic cone"),
            Literal(" is"),
            words("place", "ahead", "to the left", "to the right", "crossing"),
            Literal(", "),
            Number(0, 80, 0.5, name="distance_m"),
            Literal(" m away"),
            Maybe(
                Sequence((Literal(", at "), Number(0, 30, 1, name="speed_ms"), Literal(" m/s"))),
                name="moves",
            ),
            Literal(". "),
        )
    )
)
_THINKING: Final = Record(
    Sequence(
        (
            Literal("\n"),
            Repeat(_CUE, at_most=4, at_least=1, name="cues"),
            Literal("Going on like this"),
            words("consequence", "would be too close", "would hold up the traffic", "is safe"),
            Literal(". I should"),
            words("correction", "slow down", "slow down and stop", "speed up", "keep the plan"),
            Literal(".\n"),
        )
    )
)
_PLAN: Final = Sequence((Literal("Meta Actions:\n"), PlanTracks()))
_TRAJECTORY: Final = Sequence(
    (
        Literal("\n<|traj_future_start|>"),
        Codes(TRAJECTORY, CODES),
        Literal("<|traj_future_end|><|im_end|>"),
    )
)

PHRASES: Final = Format(
    "phrases",
    Sequence(
        (
            Section("plan", _PLAN),
            Section(
                BRANCH,
                Choice(
                    (
                        Option(ACTION, Section("trajectory", _TRAJECTORY)),
                        Option(
                            THINKING,
                            Sequence(
                                (
                                    Section("thinking", _THINKING),
                                    Section("revised_plan", _PLAN),
                                    Section("trajectory", Sequence((Literal(ACTION), _TRAJECTORY))),
                                )
                            ),
                        ),
                    ),
                    BRANCH,
                ),
            ),
        )
    ),
)
"""CF-VLA's response with phrases in place of free text."""
