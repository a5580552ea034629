"""The contract of POST /v1/label: two plans in, a teacher's reflection out."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from looktwice.clients.wire.base import MAX_SEED, Nearby, NearbyPoint, RequestModel, ResponseModel
from looktwice.clients.wire.controls import PlanGiven
from looktwice.clients.wire.scene import Scene
from looktwice.clients.wire.scenes import Agent

LaneLine = Annotated[list[NearbyPoint], Field(min_length=2, max_length=2000, fail_fast=True)]


class Annotations(RequestModel):
    """What is known about a scene besides what its cameras show; as GET /v1/scenes/ID gives it."""

    # Of long lists the first fault alone is told: a body may hold hundreds of thousands.
    agents: list[Agent] = Field(max_length=500, fail_fast=True, description="Who and what is around.")
    lane_lines: list[LaneLine] = Field(
        max_length=500, fail_fast=True, description="Centre lines of the lanes around."
    )


Seconds = Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)]


class PlanOutcome(RequestModel):
    """What a plan came to when it was followed; each failure needs the fields that tell of it."""

    fails: list[Literal["collision", "off_road", "off_route", "comfort", "behind", "ahead"]] = Field(
        min_length=1, max_length=6, description="What it failed at."
    )
    collided_s: Seconds | None = Field(default=None, description="For collision.")
    hit: (
        Literal["standing vehicle", "moving vehicle", "oncoming vehicle", "pedestrian", "obstacle"] | None
    ) = Field(default=None, description="With what it collided.")
    off_road_s: Seconds | None = Field(default=None, description="For off_road.")
    off_route_s: Seconds | None = Field(default=None, description="For off_route.")
    uncomfortable_s: Seconds | None = Field(default=None, description="For comfort.")
    uncomfortable: Annotated[str, Field(pattern="^[a-z_]{1,40}$")] | None = Field(
        default=None, description="For comfort: which bound, such as longitudinal_jerk."
    )
    driven_m: Nearby = Field(default=0.0, description="For behind and ahead: along the route.")
    expert_m: Nearby = Field(default=0.0, description="For behind and ahead: by the better plan.")


class LabelRequest(RequestModel):
    """Body of POST /v1/label."""

    scene: Scene
    predicted_plan: PlanGiven = Field(description="The plan that a model made.")
    expert_plan: PlanGiven = Field(
        description="The better plan, which the answer leads to without naming it."
    )
    annotations: Annotations | None = Field(
        default=None, description="The built-in teacher needs them; others look at the pictures."
    )
    outcome: PlanOutcome | None = Field(
        default=None,
        description="What the predicted plan failed at when it was followed: a hint at what to look for, "
        "which the answer does not tell.",
    )
    seed: int = Field(default=0, ge=0, le=MAX_SEED, description="Another one, other words.")


class TeacherName(ResponseModel):
    """Who wrote a reflection."""

    name: str
    revision: str = Field(description="Changes when it would write something else.")


class LabelResponse(ResponseModel):
    """Answer of POST /v1/label: a reflection that passed all checks."""

    request_id: str
    reflection: str = Field(description="One paragraph of at most 80 words.")
    teacher: TeacherName
    attempts: int = Field(ge=1, description="How often the teacher was asked.")
    failed_checks: list[str] = Field(description="What was wrong with its earlier answers.")
    input_tokens: int = Field(default=0, ge=0, description="That all its answers took, as it counts.")
    output_tokens: int = Field(default=0, ge=0, description="Of all its answers, as it counts.")
    cost_usd: float = Field(default=0.0, ge=0, description="Of all its answers, where prices are known.")
