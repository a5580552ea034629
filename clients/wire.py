"""The public HTTP contract: what travels over the wire, as pydantic models.

Ego frame at the scene's instant: x forward, y left, z up, metres; heading in radians, counter-clockwise
positive. Requests refuse fields they do not know; answers may grow fields, so readers ignore unknown ones.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, Protocol, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    SkipValidation,
    Tag,
    WithJsonSchema,
    model_validator,
)

Camera = Literal[
    "front_wide_120",
    "front_tele_30",
    "front_left",
    "front",
    "front_right",
    "back_left",
    "back",
    "back_right",
]
Thinking = Literal["adaptive", "always", "never"]
Decision = Literal["least_error", "drawn"]
Reasons = Literal["in_view", "any"]
Branch = Literal["Action:", "Thinking:"]
Imagine = Literal["auto", "never", "always"]
Cut = Literal["skipped", "shortened", "replaced"]
AgentKind = Literal["vehicle", "pedestrian", "cone", "barrier"]
Light = Literal["brake", "left", "right"]
Group = Literal["longitudinal", "lateral", "lane"]

PROBLEM_MEDIA_TYPE: Final = "application/problem+json"
MSGPACK_MEDIA_TYPE: Final = "application/msgpack"
MULTIPART_MEDIA_TYPE: Final = "multipart/form-data"
SSE_MEDIA_TYPE: Final = "text/event-stream"
REQUEST_ID_HEADER: Final = "X-Request-ID"
IDEMPOTENCY_KEY_HEADER: Final = "Idempotency-Key"
PART_SCHEME: Final = "cid:"
"""In a multipart body: where a picture would be, ``cid:NAME`` stands for the file part of that name."""
REQUEST_PART: Final = "request"
"""The part of a multipart body that holds the JSON."""
MAX_BATCH: Final = 64
MAX_FEEDBACK_CHARACTERS: Final = 4_000
"""Of feedback on a draft; a model's prompt may have room for less."""
MAX_SEED: Final = 2**53 - 1
"""The largest integer that every JSON reader keeps exact."""

Finite = Annotated[float, Field(allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]
Milliseconds = Annotated[float, Field(ge=0)]
Temperature = Annotated[float, Field(ge=0, le=2, description="0 takes the likeliest allowed token.")]
TopP = Annotated[float, Field(gt=0, le=1, description="Nucleus mass; 1 keeps all allowed tokens.")]
Nearby = Annotated[float, Field(ge=-100_000, le=100_000, allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]
Pose = Annotated[list[Finite], Field(min_length=4, max_length=4, description="x, y, z in m, heading in rad")]
Point = Annotated[list[Finite], Field(min_length=2, max_length=2, description="x, y in m")]
NearbyPoint = Annotated[list[Nearby], Field(min_length=2, max_length=2, description="x, y in m")]
History = Annotated[
    list[Pose],
    Field(
        min_length=16,
        max_length=16,
        description="16 ego poses at 10 Hz, oldest first; the last one is the present, (0, 0, 0, 0).",
    ),
]
Route = Annotated[
    list[Point],
    Field(min_length=20, max_length=20, description="20 points, one every 4 m along the way to go."),
]
Trajectory = Annotated[
    list[Pose],
    Field(min_length=64, max_length=64, description="64 future poses at 10 Hz; the first lies 0.1 s ahead."),
]


Poses = Annotated[
    list[Pose],
    Field(
        min_length=1,
        max_length=600,
        description="Future poses: 64 at 10 Hz, the first 0.1 s ahead, or one for each of times_s.",
    ),
]
TimesS = Annotated[
    list[Annotated[float, Field(gt=0, le=60)]] | None,
    Field(description="When the poses of the trajectory are, in s from now; null for 64 at 10 Hz."),
]


class _Timed(Protocol):
    trajectory: Poses
    times_s: TimesS


_TimedAnswer = TypeVar("_TimedAnswer", bound=_Timed)


def _check_times(answer: _TimedAnswer) -> _TimedAnswer:
    poses = 64 if answer.times_s is None else len(answer.times_s)
    if len(answer.trajectory) != poses:
        raise ValueError(f"a trajectory of {poses} poses is told, and {len(answer.trajectory)} are there")
    return answer


class Asked(BaseModel):
    """Base of everything a caller sends: unknown fields are refused."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")


class Answered(BaseModel):
    """Base of everything the service sends: readers ignore fields they do not know."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore")


def _form_of_image(value: object) -> str:
    return "bytes" if isinstance(value, bytes) else "base64"


Image = Annotated[
    Annotated[str, Tag("base64")] | Annotated[bytes, Tag("bytes")],
    Discriminator(_form_of_image),
    WithJsonSchema({"type": "string"}),
]
"""A picture: base64 in JSON, bytes in msgpack and multipart bodies."""


class Clip(Asked):
    """Four pictures of one camera over the past 2 s."""

    camera: Camera = Field(description="Which camera.")
    images: list[Image] = Field(
        min_length=4,
        max_length=4,
        description="4 pictures at 2 Hz, oldest first: JPEG, PNG or WebP, at most 4 megapixels each; "
        "in base64 without a data: prefix, in msgpack as bytes, in multipart bodies as cid:NAME of a part.",
    )


class Track(Asked):
    """One tracked road user or obstacle, now, in the ego frame."""

    x_m: Nearby = Field(description="Centre of its box.")
    y_m: Nearby
    heading_rad: Finite
    speed_ms: Finite = Field(description="Over the ground along its heading; below 0 where it reverses.")
    length_m: Length = Field(description="Of its box, along the heading.")
    width_m: Length
    kind: AgentKind
    lights: list[Light] = Field(
        default_factory=list,
        max_length=3,
        description="Those that are on; left and right together are hazard lights.",
    )


class Scene(Asked):
    """One planning instant."""

    scene_id: str = Field(default="", max_length=200, description="The caller's name for the scene.")
    clips: list[Clip] = Field(
        min_length=1, max_length=8, description="One clip per camera; GET /v1/models says which are needed."
    )
    history: History
    route: Route | None = Field(default=None, description="The way to go, or null where it is unknown.")
    tracks: list[Track] | None = Field(
        default=None,
        max_length=16,
        description="The nearest tracked objects, or null where nobody tracks; an empty list says that "
        "nobody is around. GET /v1/models says whether the model takes them.",
    )


class MetaAction(Asked):
    """One named intent over one time interval."""

    start_s: Finite = Field(description="Begin in s, on the 0.1 s grid.")
    end_s: Finite = Field(description="End in s, on the 0.1 s grid.")
    word: str = Field(max_length=40, description="e.g. Accelerate, Left Turn, Keep Lane.")


class Tracks(Asked):
    """The three tracks of a plan; each one that is there covers 0.0 s to 6.4 s without gap or overlap."""

    longitudinal: list[MetaAction] | None = Field(default=None, max_length=64)
    lateral: list[MetaAction] | None = Field(default=None, max_length=64)
    lane: list[MetaAction] | None = Field(default=None, max_length=64)


def _form_of_plan(value: object) -> str:
    return "text" if isinstance(value, str) else "tracks"


PlanGiven = Annotated[
    Annotated[str, Field(max_length=20_000), Tag("text")] | Annotated[Tracks, Tag("tracks")],
    Discriminator(_form_of_plan),
]
"""A plan as bullet text or as tracks; the discriminator keeps errors to the form that was meant."""


class ReflectControls(Asked):
    """What the caller decides about decoding behind a given plan."""

    thinking: Thinking = Field(
        default="adaptive", description="Who decides on a second look: the model, always think, never think."
    )
    think_threshold: Probability | None = Field(
        default=None,
        description="With adaptive: think exactly when the think probability exceeds it; "
        "null samples the branch.",
    )
    n: int = Field(default=6, ge=1, le=64, description="Draws.")
    temperature: Temperature = 1.0
    top_p: TopP = 1.0
    seed: int = Field(
        default=0,
        ge=0,
        le=MAX_SEED,
        description="The same request and seed give the same draws; on a CPU to the last byte.",
    )
    deadline_ms: int | None = Field(
        default=None,
        ge=1,
        le=600_000,
        description="Milliseconds from the request's arrival until the answer must be there; null for none.",
    )
    numbers: Decision = Field(
        default="least_error",
        description="How numbers in the text, such as a plan's times, are chosen: least_error takes the one "
        "of least expected error, drawn draws them as words are.",
    )
    codes: Decision = Field(
        default="least_error", description="How trajectory codes are chosen, in the same two ways."
    )
    bind: bool = Field(
        default=False,
        description="Begin only trajectories that do what the plan says, as our labeller reads them.",
    )
    reasons: Reasons = Field(
        default="in_view",
        description="What a reflection in phrases may state: only what the view gives a reason for, by the "
        "tracks or, without tracks, by what the model reads from the pictures; or anything.",
    )
    logprobs: bool = Field(
        default=False, description="Tell each draw's tokens, and how likely each of its decisions was."
    )


class Controls(ReflectControls):
    """What the caller decides about decoding."""

    prefill: PlanGiven | None = Field(
        default=None,
        description="The first plan, given instead of written by the model: bullet text, or tracks.",
    )
    imagine: Imagine = Field(
        default="auto",
        description="Who decides whether a picture half a second ahead is imagined: auto leaves it to the "
        "model. For formats that imagine, which GET /v1/models lists; refused by others.",
    )
    camera: Camera | None = Field(
        default=None,
        description="Whose picture is imagined, where one is; it need not be in the scene. null leaves it to "
        "the model.",
    )


class Attempt(Asked):
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

    _timed = model_validator(mode="after")(_check_times)


class PlanRequest(Asked):
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


class Plan(Answered):
    """A plan in both its forms; either can be sent back as `prefill`."""

    text: str = Field(description="The plan as bullet text.")
    tracks: Tracks


class Logprobs(Answered):
    """A draw token by token; both lists have as many entries as it has tokens."""

    token_ids: list[int] = Field(description="In the checkpoint's own vocabulary.")
    logprobs: list[Annotated[float, Field(le=0, allow_inf_nan=False)] | None] = Field(
        description="Natural logarithm of a token's probability among those that the format allows there, at "
        "the request's temperature (0 counts as 1), however it was chosen: least_error, top_p, thinking, "
        "bind, reasons and deadlines change nothing. null where the format forces the token."
    )


class Draw(Answered):
    """One of the n responses of a scene."""

    index: int = Field(ge=0, description="0..n-1.")
    plan: Plan | None = Field(description="The first plan; null where the format has none.")
    branch: Branch | None = Field(description="Action: (direct) or Thinking: (a second look was taken).")
    think_probability: Probability | None = Field(description="Probability of Thinking: at the branch.")
    thinking: str | None = Field(description="The reasoning; null without a second look.")
    revised_plan: Plan | None = Field(description="The plan after reasoning; null without a second look.")
    trajectory: Poses
    times_s: TimesS = None
    draft_trajectory: Poses | None = Field(
        default=None,
        description="Where the first plan would have led; made beside a second look under a deadline.",
    )
    cut: Cut | None = Field(
        default=None,
        description="What the deadline did to the second look: skipped, shortened, or replaced by the draft.",
    )
    consistent: bool | None = Field(
        default=None,
        description="Whether the parts of the draw agree; null where nothing can be said.",
    )
    disagreements: list[str] = Field(
        default_factory=list,
        description="Which parts do not: plan_trajectory (the trajectory does something else than the plan "
        "it follows), reason_change (the revised plan does not change as the reasoning asks for).",
    )
    reasons: list[str] | None = Field(
        default=None,
        description="The statements that the reflection could make, by what is in view; null without a "
        "reflection, and where it could make any.",
    )
    tokens: dict[str, int] = Field(description="Tokens per section of the response.")
    logprobs: Logprobs | None = Field(default=None, description="Null unless asked for.")

    _timed = model_validator(mode="after")(_check_times)


class ModelName(Answered):
    """Which weights answered."""

    name: str
    revision: str = Field(description="Changes with the weights.")


class Timing(Answered):
    """Where the time went, in milliseconds."""

    total_ms: Milliseconds = Field(description="From the request's arrival to the finished answer.")
    checks_ms: Milliseconds = Field(description="Base64, picture headers and geometry.")
    engine_ms: Milliseconds = Field(description="In the engine, waiting for a place in the batch included.")
    queue_ms: Milliseconds = Field(default=0.0, description="Of these: waiting for a place in the batch.")


class Deadline(Answered):
    """What became of a deadline."""

    met: bool = Field(description="Whether the answer was finished in time.")
    cut: list[int] = Field(description="Draws whose second look was skipped, shortened or replaced.")


class PlanResponse(Answered):
    """Answer of POST /v1/plan."""

    request_id: str
    model: ModelName
    draws: list[Draw]
    agreed: int = Field(
        ge=0, description="Index of the draw whose trajectory is nearest to all others': the one to drive by."
    )
    timing: Timing
    deadline: Deadline | None = Field(default=None, description="Null where none was set.")


class BatchRequest(Asked):
    """Body of POST /v1/plan/batch."""

    # Each is checked by itself, so that one that breaks the contract fails alone.
    requests: list[SkipValidation[PlanRequest]] = Field(
        min_length=1, max_length=MAX_BATCH, description="Planned for together; none may stream."
    )


class ReflectRequest(Asked):
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


class PlanChange(Answered):
    """A stretch of one track in which the revised plan says something else than the given one."""

    group: Group
    start_s: float
    end_s: float
    proposed: str | None = Field(description="The word of the given plan; null where it has no such track.")
    revised: str | None = Field(description="The word of the revised plan; null where it has none.")


class Reflection(Answered):
    """One of the n looks at the given plan."""

    index: int = Field(ge=0, description="0..n-1.")
    decision: Literal["keep", "revise"] = Field(
        description="keep where the model would drive by the given plan, revise where it says otherwise."
    )
    thinking: str | None = Field(description="The reasoning; null without a second look.")
    revised_plan: Plan | None = Field(description="The plan after reasoning; null without a second look.")
    plan_iou: float = Field(
        ge=0, le=1, description="Intersection over union of given and revised plan, in bins of 0.1 s."
    )
    changes: list[PlanChange] = Field(description="Where they do not, track by track; empty when kept.")
    trajectory: Poses
    times_s: TimesS = None
    cut: Cut | None = Field(
        default=None,
        description="What the deadline did to the second look: skipped, shortened, or replaced by the draft.",
    )
    consistent: bool | None = Field(
        default=None,
        description="Whether the parts of the draw agree; null where nothing can be said.",
    )
    disagreements: list[str] = Field(
        default_factory=list,
        description="Which parts do not: plan_trajectory (the trajectory does something else than the plan "
        "it follows), reason_change (the revised plan does not change as the reasoning asks for).",
    )
    reasons: list[str] | None = Field(
        default=None,
        description="The statements that the reflection could make, by what is in view; null without a "
        "reflection, and where it could make any.",
    )
    tokens: dict[str, int] = Field(description="Tokens per section of the response.")
    logprobs: Logprobs | None = Field(default=None, description="Null unless asked for.")

    _timed = model_validator(mode="after")(_check_times)


class ReflectResponse(Answered):
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


class Agent(Answered):
    """Another road user or obstacle of a labelled scene, as an oriented box over past and future."""

    agent_id: int
    kind: str = Field(description="vehicle, pedestrian, cone or barrier.")
    length_m: Length
    width_m: Length
    poses: list[Annotated[list[Nearby], Field(min_length=3, max_length=3)] | None] = Field(
        min_length=80,
        max_length=80,
        description="80 poses (x, y in m, heading in rad) at 10 Hz, row 15 is now; null where absent.",
    )


class Annotations(Asked):
    """What is known about a scene besides what its cameras show; as GET /v1/scenes/ID gives it."""

    agents: list[Agent] = Field(max_length=500, description="Who and what is around.")
    lane_lines: list[Annotated[list[NearbyPoint], Field(min_length=2, max_length=2000)]] = Field(
        max_length=500, description="Centre lines of the lanes around."
    )


Seconds = Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)]


class PlanOutcome(Asked):
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


class LabelRequest(Asked):
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


class TeacherName(Answered):
    """Who wrote a reflection."""

    name: str
    revision: str = Field(description="Changes when it would write something else.")


class LabelResponse(Answered):
    """Answer of POST /v1/label: a reflection that passed all checks."""

    request_id: str
    reflection: str = Field(description="One paragraph of at most 80 words.")
    teacher: TeacherName
    attempts: int = Field(ge=1, description="How often the teacher was asked.")
    failed_checks: list[str] = Field(description="What was wrong with its earlier answers.")
    input_tokens: int = Field(default=0, ge=0, description="That all its answers took, as it counts.")
    output_tokens: int = Field(default=0, ge=0, description="Of all its answers, as it counts.")
    cost_usd: float = Field(default=0.0, ge=0, description="Of all its answers, where prices are known.")


class ModelCard(Answered):
    """What a loaded checkpoint is."""

    name: str
    revision: str = Field(description="Changes with the weights.")
    engine: str = Field(description="torch or vllm.")
    formats: list[str] = Field(description="Response formats it writes.")
    refines: list[str] = Field(
        default_factory=list, description="Of these, the ones that refine an attempt, which they need."
    )
    imagines: list[str] = Field(
        default_factory=list, description="Of these, the ones that may imagine a picture half a second ahead."
    )
    paints: bool = Field(
        default=False, description="Whether it can paint what it imagines, as POST /v1/imagine asks."
    )
    cameras: list[str] = Field(description="Cameras it needs; a scene must have a clip of each.")
    image_size: Annotated[list[int], Field(min_length=2, max_length=2)] = Field(
        description="Width and height in pixels that pictures are resized to."
    )
    parameters: int = Field(description="How many weights.")
    inputs: list[str] = Field(
        default_factory=lambda: ["route"],
        description="What it takes of a scene beside pictures and history: route, tracks.",
    )
    details: dict[str, Any] = Field(default_factory=dict)


class NamedModel(Answered):
    """A model as clients of OpenAI's API expect it."""

    id: str
    object: Literal["model"] = "model"
    created: int = Field(description="When the service began, in s since 1970.")
    owned_by: str = "looktwice"


class ModelList(Answered):
    """Answer of GET /v1/models; `object` and `data` are for clients of OpenAI's API."""

    object: Literal["list"] = "list"
    data: list[NamedModel] = Field(default_factory=list)

    models: list[ModelCard]
    teacher: TeacherName | None = Field(
        default=None, description="Who writes the labels of POST /v1/label; null where nobody does."
    )


class LabelledScene(Answered):
    """A scene with what is known about it besides, for looking at; `scene` can be planned for as it is."""

    scene: Scene
    episode_id: str
    seed: int
    future: Trajectory
    agents: list[Agent]
    drivable: list[list[Point]] = Field(
        description="Closed rings; a point is on the road when an odd number of rings contains it."
    )
    lane_lines: list[list[Point]] = Field(description="Centre lines of the lanes around.")
    tracks: list[Track] = Field(
        default_factory=list,
        description="What a perfect tracker would tell of the agents, for `scene.tracks`.",
    )
    tags: list[str] = Field(description="What makes the scene difficult.")


class LoadRequest(Asked):
    """Body of POST /v1/models:load."""

    checkpoint: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$", description="Name of a folder among the checkpoints."
    )


class SceneEntry(Answered):
    """A line in the list of bundled scenes."""

    scene_id: str
    tags: list[str]


class SceneList(Answered):
    """Answer of GET /v1/scenes."""

    scenes: list[SceneEntry]


class SceneFile(Answered):
    """Answer of POST /v1/scenes:read."""

    scenes: list[LabelledScene]


class Fault(Answered):
    """One thing that is wrong with a request."""

    pointer: str = Field(description="JSON pointer (RFC 6901) into the body.")
    detail: str
    line: int | None = Field(default=None, description="Of a text in the body, from 1.")
    column: int | None = Field(default=None, description="In that line, from 1.")


class Problem(Answered):
    """A problem document (RFC 9457)."""

    type: str = Field(description="Stable URI of the kind of problem.")
    title: str
    status: int
    detail: str = Field(description="What is wrong here, and what to change.")
    request_id: str
    errors: list[Fault] = Field(
        default_factory=list, description="Every fault found, where there are places."
    )


class BatchResult(Answered):
    """What became of one request of a batch: its answer, or its problem."""

    status: int = Field(description="That the request alone would have been answered with.")
    response: PlanResponse | None = None
    problem: Problem | None = None


class BatchResponse(Answered):
    """Answer of POST /v1/plan/batch: a result per request, in their order."""

    results: list[BatchResult]


class PlanWritten(Answered):
    """Data of the events `plan` and `revised_plan`."""

    index: int
    plan: Plan


class BranchTaken(Answered):
    """Data of the event `branch`."""

    index: int
    branch: Branch


class ThinkingWritten(Answered):
    """Data of the event `thinking`: more of the reasoning, to be put behind what came before."""

    index: int
    text: str


class TrajectoryWritten(Answered):
    """Data of the events `draft_trajectory` and `trajectory`; whether parts agree is not said of a draft."""

    index: int
    trajectory: Poses
    times_s: TimesS = None
    consistent: bool | None = Field(default=None, description="As in the finished draw.")
    disagreements: list[str] = Field(default_factory=list, description="As in the finished draw.")

    _timed = model_validator(mode="after")(_check_times)


Event = PlanWritten | BranchTaken | TrajectoryWritten | ThinkingWritten | Problem

EVENTS: Final[dict[str, type[Event]]] = {
    "plan": PlanWritten,
    "branch": BranchTaken,
    "draft_trajectory": TrajectoryWritten,
    "thinking": ThinkingWritten,
    "revised_plan": PlanWritten,
    "trajectory": TrajectoryWritten,
    "error": Problem,
}
"""Server-sent events and their data; `done` ends the stream with what the answer would have been without."""
