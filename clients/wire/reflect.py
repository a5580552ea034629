"""The contract of POST /v1/reflect: a scene and a plan in, n looks at it out."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from looktwice.clients.wire.base import (
    ModelName,
    Poses,
    Probability,
    RequestModel,
    ResponseModel,
    TimesS,
    check_times,
)
from looktwice.clients.wire.controls import PlanGiven, ReflectControls
from looktwice.clients.wire.plan import (
    Consistent,
    CutOfDraw,
    Deadline,
    Disagreements,
    LogprobsOfDraw,
    Plan,
    Reasoning,
    ReasonsInView,
    RevisedPlan,
    Timing,
    TokenCounts,
)
from looktwice.clients.wire.scene import Scene

Group = Literal["longitudinal", "lateral", "lane"]


class ReflectRequest(RequestModel):
    """Body of POST /v1/reflect."""

    scene: Scene
    plan: PlanGiven = Field(description="The plan to be looked at, from any planner: bullet text, or tracks.")
    controls: ReflectControls = ReflectControls()
    format: str | None = Field(
        default=None,
        max_length=40,
        description="Response format; GET /v1/models lists them, the default first.",
    )
    stream: bool = Field(default=False, description="Answer with server-sent events, as draws are written.")


class PlanChange(ResponseModel):
    """A stretch of one track in which the revised plan says something else than the given one."""

    group: Group
    start_s: float
    end_s: float
    proposed: str | None = Field(description="The word of the given plan; null where it has no such track.")
    revised: str | None = Field(description="The word of the revised plan; null where it has none.")


class Reflection(ResponseModel):
    """One of the n looks at the given plan."""

    index: int = Field(ge=0, description="0..n-1.")
    decision: Literal["keep", "revise"] = Field(
        description="keep where the model would drive by the given plan, revise where it says otherwise."
    )
    thinking: Reasoning
    revised_plan: RevisedPlan
    plan_iou: float = Field(
        ge=0, le=1, description="Intersection over union of given and revised plan, in bins of 0.1 s."
    )
    changes: list[PlanChange] = Field(description="Where they do not, track by track; empty when kept.")
    trajectory: Poses
    times_s: TimesS = None
    cut: CutOfDraw = None
    consistent: Consistent = None
    disagreements: Disagreements = Field(default_factory=list)
    reasons: ReasonsInView = None
    tokens: TokenCounts
    logprobs: LogprobsOfDraw = None

    _timed = model_validator(mode="after")(check_times)


class ReflectResponse(ResponseModel):
    """Answer of POST /v1/reflect."""

    request_id: str
    model: ModelName
    plan: Plan = Field(description="The given plan, as the model read it.")
    think_probability: Probability = Field(
        description="Probability of a second look behind the given plan, the same for all draws."
    )
    draws: list[Reflection]
    timing: Timing
    deadline: Deadline | None = Field(default=None, description="Null where none was set.")
