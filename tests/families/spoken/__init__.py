"""A family that plans, may look twice, and gives its trajectory in digits: any tokenizer can spell it."""

from __future__ import annotations

from typing import Final

from looktwice.model.driving.plan import Plan
from looktwice.model.families.elf_vla.format import poses, read_poses
from looktwice.model.families.family import Branch, Decode, Family, Reading
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
from looktwice.model.formats.plan_tracks import PlanTracks

_TIMES_S: Final = (2.0, 4.0)
_POSES: Final = Sequence((Literal(" "), poses(len(_TIMES_S)), Literal("\n")))
_LOOK: Final = Sequence(
    (
        Section("thought", Sequence((Literal(" "), FreeText("\n", 24)))),
        Section("second", Sequence((Literal("Better:\n"), PlanTracks()))),
        Section("drive", Sequence((Literal("Go:"), _POSES))),
    )
)
_BRANCH: Final = Choice((Option("Go:", Section("drive", _POSES)), Option("Wait:", _LOOK)), name="mood")


def read(values: Values, decode: Decode) -> Reading:
    """What it says. There are no codes to decode."""
    first, second = values["first"], values.get("second")
    return Reading(
        read_poses(values["drive"]),
        plan=first if isinstance(first, Plan) else None,
        branch=str(values["mood"]),
        revised_plan=second if isinstance(second, Plan) else None,
    )


SPOKEN: Final = Family(
    format=Format(
        "spoken",
        Sequence((Section("first", Sequence((Literal("Plan:\n"), PlanTracks()))), Section("mood", _BRANCH))),
    ),
    task="Plan how to drive.",
    trajectory="drive",
    read=read,
    times_s=_TIMES_S,
    first_plan="first",
    branch=Branch("mood", direct="Go:", reflecting="Wait:"),
    reflection="thought",
    revised_plan="second",
)
