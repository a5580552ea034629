"""The contract of POST /v1/refine: a scene, a draft and feedback on it in, refinements out.

A request has no place for what the human drove, for futures of others, or for labels. All that drafts are
judged and refinements are scored by is known on the road. Source: ELF-VLA, section 7.2 of its supplement.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Discriminator, Field, Tag

import looktwice.clients.wire as wire
from looktwice.clients.wire import (
    MAX_FEEDBACK_CHARACTERS,
    Deadline,
    Draw,
    ModelName,
    Pose,
    Probability,
    ReflectControls,
    RequestModel,
    ResponseModel,
    Scene,
    Timing,
)
from looktwice.clients.wire_feedback import PlanId
from looktwice.clients.wire_scores import ScoreVersion, TrajectoryScore

AUTO: Final = "auto"
MAX_SECTION_CHARACTERS: Final = 700
"""Five of them and their headings are a text; those of the paper have 400 at most."""

Foresight = Literal["constant_velocity"]
DraftPoses = Annotated[
    list[Pose],
    Field(min_length=8, max_length=64, description="8 poses at 0.5 s, or 64 at 0.1 s; the first is not now."),
]
_Section = Annotated[str, Field(min_length=1, max_length=MAX_SECTION_CHARACTERS)]


class SectionsGiven(RequestModel):
    """A teacher's five sections, a paragraph each; as POST /v1/feedback answers them."""

    meta_action: _Section
    think_process: _Section
    safety_failure: _Section
    efficiency_failure: _Section
    correction: _Section
    plan_id: PlanId | None = Field(
        default=None,
        description="Of the trajectory that they were written for, as POST /v1/feedback names it. Where it "
        "is given, it must be the draft's.",
    )


def _form_of_feedback(value: object) -> str:
    return "text" if isinstance(value, str) else "sections"


FeedbackGiven = Annotated[
    Annotated[str, Field(min_length=1, max_length=MAX_FEEDBACK_CHARACTERS), Tag("text")]
    | Annotated[SectionsGiven, Tag("sections")],
    Discriminator(_form_of_feedback),
]


class RefineRequest(RequestModel):
    """Body of POST /v1/refine."""

    scene: Scene = Field(
        description="Its tracks are what scores and automatic feedback go by; the model sees them too where "
        "it takes tracks."
    )
    draft: DraftPoses = Field(description="From any planner: 8 poses at 0.5 s, or 64 at 0.1 s.")
    feedback: FeedbackGiven = Field(
        default=AUTO,
        description="What is said of the draft: any words, or five sections; auto lets the built-in teacher "
        "write, by the scene's tracks.",
    )
    threshold: Probability = Field(
        default=0.8, description="Of auto: a draft whose score is at least this is told to be right."
    )
    controls: ReflectControls = Field(default=ReflectControls(), description="n refinements are made.")
    stream: bool = Field(
        default=False, description="Answer with server-sent events, as refinements are written."
    )


class DraftFeedback(ResponseModel):
    """What the model was told of the draft."""

    text: str = Field(description="As the model read it.")
    written_by: Literal["rules", "caller"]
    correct: bool | None = Field(
        description="Of auto: whether the draft is right, by its score; null where the caller wrote."
    )


class Refinement(Draw):
    """One of the n refinements."""

    after: TrajectoryScore | None = Field(
        description="What it is worth; null without tracks, where it ends within 4 s, and where no car can "
        "follow it."
    )


class DraftJudged(ResponseModel):
    """What is known of the draft before it is refined; data of the event `feedback`."""

    feedback: DraftFeedback
    foresight: Foresight | None = Field(
        description="How the future that feedback and scores are made in was foreseen: the tracks go on at "
        "constant velocity. Null where there are no tracks, and so neither."
    )
    version: ScoreVersion = Field(description="Whose rules scores are by.")
    missing: list[str] = Field(
        description="Sub-scores that count and are not known on the road: scores are partial ones."
    )
    before: TrajectoryScore | None = Field(description="What the draft is worth; null without tracks.")


class RefineResponse(DraftJudged):
    """Answer of POST /v1/refine."""

    request_id: str
    model: ModelName
    format: str = Field(description="The model's first format that refines.")
    draws: list[Refinement]
    agreed: int = Field(
        ge=0, description="Index of the refinement whose trajectory is nearest to all others'."
    )
    timing: Timing
    deadline: Deadline | None = Field(default=None, description="Null where none was set.")


Event = wire.Event | DraftJudged

EVENTS: Final[dict[str, type[Event]]] = {"feedback": DraftJudged, **wire.EVENTS}
"""Server-sent events and their data; `done` ends the stream with what the answer would have been without."""
