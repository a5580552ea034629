"""What the streams of POST /v1/plan and /v1/reflect tell."""

from __future__ import annotations

from typing import Final

from pydantic import Field, model_validator

from looktwice.clients.wire.base import Poses, ResponseModel, TimesS, check_times
from looktwice.clients.wire.plan import Branch, Plan, Section
from looktwice.clients.wire.problem import Problem


class PlanWritten(ResponseModel):
    """Data of the events `plan` and `revised_plan`."""

    index: int
    plan: Plan


class BranchTaken(ResponseModel):
    """Data of the event `branch`."""

    index: int
    branch: Branch


class ThinkingWritten(ResponseModel):
    """Data of the event `thinking`: more of the reasoning, to be put behind what came before."""

    index: int
    text: str


class SectionWritten(ResponseModel):
    """Data of the event `section`: one that only the format has is finished."""

    index: int
    section: Section


class TrajectoryWritten(ResponseModel):
    """Data of the events `draft_trajectory` and `trajectory`; whether parts agree is not said of a draft."""

    index: int
    trajectory: Poses
    times_s: TimesS = None
    consistent: bool | None = Field(default=None, description="As in the finished draw.")
    disagreements: list[str] = Field(default_factory=list, description="As in the finished draw.")

    _timed = model_validator(mode="after")(check_times)


Event = PlanWritten | BranchTaken | SectionWritten | TrajectoryWritten | ThinkingWritten | Problem
EVENTS: Final[dict[str, type[Event]]] = {
    "plan": PlanWritten,
    "branch": BranchTaken,
    "draft_trajectory": TrajectoryWritten,
    "thinking": ThinkingWritten,
    "revised_plan": PlanWritten,
    "section": SectionWritten,
    "trajectory": TrajectoryWritten,
    "error": Problem,
}
"""Server-sent events and their data; `done` ends the stream with what the answer would have been without."""
