"""The contract of POST /v1/plan and /v1/plan/batch: a scene in, n draws out."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field, JsonValue, SkipValidation, model_validator

from looktwice.clients.wire.base import (
    Milliseconds,
    ModelName,
    Poses,
    Probability,
    RequestModel,
    ResponseModel,
    TimesS,
    check_times,
)
from looktwice.clients.wire.controls import Controls, Tracks
from looktwice.clients.wire.problem import Problem
from looktwice.clients.wire.scene import Scene

Branch = Literal["Action:", "Thinking:"]
Cut = Literal["skipped", "shortened", "replaced"]
MAX_BATCH: Final = 64
MAX_FEEDBACK_CHARACTERS: Final = 4_000
"""Of feedback on a draft; a model's prompt may have room for less."""


class Attempt(RequestModel):
    """An answer that was given to the scene before, and what is said of it."""

    trajectory: Poses = Field(description="The draft: 64 poses, or one for each of times_s.")
    times_s: TimesS = Field(
        default=None, description="When its poses are, as the format has them; null for 64 at 10 Hz."
    )
    feedback: str = Field(
        min_length=1,
        max_length=MAX_FEEDBACK_CHARACTERS,
        description="Any words, such as the `text` of POST /v1/feedback, as far as the prompt has room.",
    )

    _timed = model_validator(mode="after")(check_times)


class PlanRequest(RequestModel):
    """Body of POST /v1/plan."""

    scene: Scene
    controls: Controls = Controls()
    attempt: Attempt | None = Field(
        default=None,
        description="To be refined; needed by formats that refine, which GET /v1/models lists, and refused "
        "by others.",
    )
    format: str | None = Field(
        default=None,
        max_length=40,
        description="Response format; GET /v1/models lists them, the default first.",
    )
    stream: bool = Field(default=False, description="Answer with server-sent events, as draws are written.")


class Plan(ResponseModel):
    """A plan in both its forms; either can be sent back as `prefill`."""

    text: str = Field(description="The plan as bullet text.")
    tracks: Tracks


class Logprobs(ResponseModel):
    """A draw token by token; both lists have as many entries as it has tokens."""

    token_ids: list[int] = Field(description="In the checkpoint's own vocabulary.")
    logprobs: list[Annotated[float, Field(le=0, allow_inf_nan=False)] | None] = Field(
        description="Natural logarithm of a token's probability among those that the format allows there, at "
        "the request's temperature (0 counts as 1), however it was chosen: least_error, top_p, thinking, "
        "bind, reasons and deadlines change nothing. null where the format forces the token."
    )


# What draws of a scene and looks at a given plan tell alike.
Reasoning = Annotated[str | None, Field(description="The reasoning; null without a second look.")]
RevisedPlan = Annotated[
    Plan | None, Field(description="The plan after reasoning; null without a second look.")
]
CutOfDraw = Annotated[
    Cut | None,
    Field(
        description="What the deadline did to the second look: skipped, shortened, or replaced by the draft."
    ),
]
Consistent = Annotated[
    bool | None,
    Field(description="Whether the parts of the draw agree; null where nothing can be said."),
]
Disagreements = Annotated[
    list[str],
    Field(
        description="Which parts do not: plan_trajectory (the trajectory does something else than the plan "
        "it follows), reason_change (the revised plan does not change as the reasoning asks for)."
    ),
]
ReasonsInView = Annotated[
    list[str] | None,
    Field(
        description="The statements that the reflection could make, by what is in view; null without a "
        "reflection, and where it could make any."
    ),
]
TokenCounts = Annotated[dict[str, int], Field(description="Tokens per section of the response.")]
LogprobsOfDraw = Annotated[Logprobs | None, Field(description="Null unless asked for.")]


class Section(ResponseModel):
    """A section of a response that has no field of its own."""

    name: str = Field(description="As the format calls it.")
    values: list[JsonValue] = Field(
        description="What it says: numbers, words, lists of repeated values, objects of named ones."
    )


class Draw(ResponseModel):
    """One of the n responses of a scene."""

    index: int = Field(ge=0, description="0..n-1.")
    plan: Plan | None = Field(description="The first plan; null where the format has none.")
    branch: Branch | None = Field(description="Action: (direct) or Thinking: (a second look was taken).")
    think_probability: Probability | None = Field(description="Probability of Thinking: at the branch.")
    thinking: Reasoning
    revised_plan: RevisedPlan
    trajectory: Poses
    times_s: TimesS = None
    draft_trajectory: Poses | None = Field(
        default=None,
        description="Where the first plan would have led; made beside a second look under a deadline.",
    )
    cut: CutOfDraw = None
    consistent: Consistent = None
    disagreements: Disagreements = Field(default_factory=list)
    reasons: ReasonsInView = None
    sections: list[Section] = Field(
        default_factory=list, description="What only this format has, in its order; [] where it has no more."
    )
    tokens: TokenCounts
    logprobs: LogprobsOfDraw = None

    _timed = model_validator(mode="after")(check_times)


class Timing(ResponseModel):
    """Where the time went, in milliseconds."""

    total_ms: Milliseconds = Field(description="From the request's arrival to the finished answer.")
    checks_ms: Milliseconds = Field(description="Base64, picture headers and geometry.")
    engine_ms: Milliseconds = Field(description="In the engine, waiting for a place in the batch included.")
    queue_ms: Milliseconds = Field(default=0.0, description="Of these: waiting for a place in the batch.")


class Deadline(ResponseModel):
    """What became of a deadline."""

    met: bool = Field(description="Whether the answer was finished in time.")
    cut: list[int] = Field(description="Draws whose second look was skipped, shortened or replaced.")


class PlanResponse(ResponseModel):
    """Answer of POST /v1/plan."""

    request_id: str
    model: ModelName
    draws: list[Draw]
    agreed: int = Field(
        ge=0, description="Index of the draw whose trajectory is nearest to all others': the one to drive by."
    )
    timing: Timing
    deadline: Deadline | None = Field(default=None, description="Null where none was set.")


class BatchRequest(RequestModel):
    """Body of POST /v1/plan/batch."""

    # Each is checked by itself, so that one that breaks the contract fails alone.
    requests: list[SkipValidation[PlanRequest]] = Field(
        min_length=1, max_length=MAX_BATCH, description="Planned for together; none may stream."
    )


class BatchResult(ResponseModel):
    """What became of one request of a batch: its answer, or its problem."""

    status: int = Field(description="That the request alone would have been answered with.")
    response: PlanResponse | None = None
    problem: Problem | None = None


class BatchResponse(ResponseModel):
    """Answer of POST /v1/plan/batch: a result per request, in their order."""

    results: list[BatchResult]
