"""The contract of POST /v1/feedback: labels and trajectories in, why each one fails out.

Source: ELF-VLA, section 7.2 and figures 7 and 8 of its supplement.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import FailFast, Field, model_validator

from looktwice.clients.wire import RequestModel, ResponseModel, TeacherName
from looktwice.clients.wire_scores import ScoreRequest, ScoreTrajectory, ScoreVersion

MAX_FEEDBACK: Final = 64
"""Trajectories of one request."""

FeedbackMode = Literal["teacher", "rule"]
PlanId = Annotated[str, Field(pattern="^[0-9a-f]{12}$")]


class WrittenFeedback(RequestModel):
    """Feedback that another teacher wrote, to be checked against the facts of the trajectory."""

    text: Annotated[str, Field(min_length=1, max_length=10_000)] = Field(
        description="Five sections, as an answer tells them."
    )
    plan_id: PlanId | None = Field(
        default=None, description="Of the plan that it was written for, as an answer names it."
    )


class PlanSaid(RequestModel):
    """What a planner says of one trajectory."""

    plan: Annotated[str, Field(max_length=10_000)] | None = Field(default=None, description="In words.")
    think: Annotated[str, Field(max_length=10_000)] | None = Field(
        default=None, description="Its reasoning; the second section of feedback is about it."
    )
    written: WrittenFeedback | None = Field(
        default=None, description="Is taken in the place of the teacher's, once it is checked."
    )


class FeedbackRequest(ScoreRequest):
    """Body of POST /v1/feedback: what /v1/score takes, and what a teacher has to know besides."""

    trajectories: Annotated[list[ScoreTrajectory], FailFast()] = Field(
        min_length=1, max_length=MAX_FEEDBACK, description="All of one length."
    )
    version: ScoreVersion = Field(
        default="v1.1", description="v1.1 is PDMS, which the paper judges by; v2.2 is EPDMS."
    )
    ground_truth: ScoreTrajectory | None = Field(
        default=None,
        description="What the human drove. With scene_id it is the expert's future where none is given. "
        "Progress is measured against it where no reference is given.",
    )
    said: list[PlanSaid | None] | None = Field(
        default=None, max_length=MAX_FEEDBACK, description="As many as trajectories; null where nothing is."
    )
    command: Annotated[str, Field(max_length=200)] | None = Field(
        default=None, description="Where the ego is to go, for the teacher."
    )
    threshold: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = Field(
        default=0.8, description="A trajectory whose score is at least this is correct."
    )
    mode: FeedbackMode = Field(
        default="teacher", description="teacher: five sections on what is wrong; rule: verdicts only."
    )

    @model_validator(mode="after")
    def _one_each(self) -> FeedbackRequest:
        if self.said is not None and len(self.said) != len(self.trajectories):
            raise ValueError(f"said has {len(self.said)} entries for {len(self.trajectories)} trajectories")
        if self.mode == "rule" and any(each is not None and each.written for each in self.said or ()):
            raise ValueError("written feedback has a place only with mode teacher")
        return self


class FailureMeasure(ResponseModel):
    """By how much a plan fails."""

    name: str = Field(description="What is measured; it ends in the unit.")
    value: float
    limit: float | None = Field(description="That the value passes; null where there is none.")
    beyond: float | None = Field(description="How far the value is from the limit.")


class FailureOther(ResponseModel):
    """With whom a plan fails; null where it is not there, or has no place."""

    other_id: str
    kind: str
    now_ahead_m: float | None = Field(description="Its centre, from the middle of the ego's box now.")
    now_left_m: float | None
    ahead_m: float | None = Field(description="The same when the plan fails.")
    left_m: float | None
    gap_m: float | None = Field(description="Between the boxes then; 0 where they touch.")
    closing_mps: float | None = Field(description="Negative where the two part.")
    speed_mps: float | None = Field(description="Its own then.")


class FailureFact(ResponseModel):
    """One sub-score below its full value."""

    sub_score: str
    value: float
    time_s: float | None = Field(description="When it fails first; null where plans are judged as a whole.")
    other: FailureOther | None
    side: Literal["left", "right"] | None = Field(
        description="Where it leaves the road, or goes beside the centre line."
    )
    measures: list[FailureMeasure]


class PlanCourse(ResponseModel):
    """How a trajectory goes over the 4 s that are judged."""

    speed_mps: float = Field(description="Now.")
    end_speed_mps: float
    mean_speed_mps: float
    ahead_m: float = Field(description="Where it ends, in the ego frame of now.")
    left_m: float
    turned_rad: float
    longitudinal: str = Field(description="accelerate, decelerate, maintain speed or stop.")
    lateral: str = Field(description="keep lane, turn left or right, change to left or right lane.")


class FeedbackSections(ResponseModel):
    """A teacher's five sections."""

    meta_action: str
    think_process: str
    safety_failure: str
    efficiency_failure: str
    correction: str


class PlanFeedback(ResponseModel):
    """What is said of one trajectory."""

    plan_id: PlanId = Field(description="Stands for the trajectory.")
    score: float | None = Field(description="0 to 1; null where a sub-score that counts is missing.")
    partial_score: float | None
    judged_by: Literal["score", "partial_score"] = Field(description="Which was held to the threshold.")
    correct: bool
    sub_scores: dict[str, float | None]
    facts: list[FailureFact] = Field(description="In the order of time; empty where nothing is lowered.")
    course: PlanCourse
    true_course: PlanCourse | None = Field(description="Of the ground truth; null without one.")
    sections: FeedbackSections | None = Field(
        description="Of trajectories that are wrong; null of correct ones, and with mode rule."
    )
    text: str = Field(description="The feedback as a model reads it: the sections, or the verdict by rule.")
    written_by: str = Field(description="rules, openai:MODEL, or caller.")
    attempts: int = Field(description="How often the teacher was asked; 0 where nobody was.")


class FeedbackResponse(ResponseModel):
    """Answer of POST /v1/feedback."""

    request_id: str
    version: ScoreVersion
    missing: list[str] = Field(description="Sub-scores that count and are null for every trajectory.")
    against: str | None = Field(description="What progress was measured against.")
    threshold: float
    teacher: TeacherName = Field(description="Who writes sections here.")
    feedback: list[PlanFeedback]
