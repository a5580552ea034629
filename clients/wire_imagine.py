"""The contract of POST /v1/imagine: a scene and a camera in, pictures of half a second later out.

Source: VLA-World (arXiv 2604.09059), section 3.4.
"""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Field

from looktwice.clients.wire import (
    MAX_SEED,
    AgentKind,
    Camera,
    Decision,
    Finite,
    Length,
    ModelName,
    Motion,
    Nearby,
    Poses,
    Problem,
    RequestModel,
    ResponseModel,
    Scene,
    Temperature,
    TimesS,
    Timing,
    TopP,
)

SECONDS_AHEAD: Final = 0.5
PICTURE_CODES: Final = 98
ROW_CODES: Final = 14
"""A row of a picture; progress is told row by row."""

Index = Annotated[int, Field(ge=0, description="0..n-1.")]


class ImagineControls(RequestModel):
    """What the caller decides about decoding."""

    n: int = Field(default=1, ge=1, le=64, description="Pictures.")
    temperature: Temperature = 1.0
    top_p: TopP = 1.0
    seed: int = Field(
        default=0,
        ge=0,
        le=MAX_SEED,
        description="The same request and seed give the same pictures; on a CPU to the last byte.",
    )
    numbers: Decision = Field(
        default="least_error",
        description="How metres are chosen: least_error takes the ones of least expected error, drawn draws "
        "them as words are.",
    )
    codes: Decision = Field(
        default="least_error",
        description="How the picture's codes are chosen, in the same two ways. Drawn ones show what else may "
        "be seen, and are noisier.",
    )


class ImagineRequest(RequestModel):
    """Body of POST /v1/imagine."""

    scene: Scene
    camera: Camera = Field(
        description="Whose picture is to be imagined; it need not be among the cameras of the scene."
    )
    motion: Motion | None = Field(
        default=None,
        description="Asks what the camera would see if the ego did this. null leaves it to the model.",
    )
    trajectory: Poses | None = Field(
        default=None,
        description="Asks the same of a trajectory, instead of a motion: where it is in half a second, which "
        "must lie within it. That of a draw can be sent back as it is, with its times_s.",
    )
    times_s: TimesS = Field(
        default=None, description="When the poses of the trajectory are, in s from now; null for 64 at 10 Hz."
    )
    controls: ImagineControls = Field(default=ImagineControls(), description="n pictures are made.")
    stream: bool = Field(
        default=False, description="Answer with server-sent events, as pictures are written."
    )


class SeenObject(ResponseModel):
    """One road user or obstacle that the model tells of, now, in the ego frame."""

    kind: AgentKind
    x_m: Nearby = Field(description="Centre of its box.")
    y_m: Nearby
    length_m: Length
    width_m: Length


class PerceivedObject(SeenObject):
    """The same, with what the model says of it in the end."""

    near_s: float | None = Field(
        description="When the model expects it in the safe zone around the ego; null for never."
    )


class Edges(ResponseModel):
    """How far the edges of the road are."""

    left_m: float = Field(ge=0, description="From the ego's left side to the edge of the road.")
    right_m: float = Field(ge=0, description="The same on the right.")


class Seen(Edges):
    """What the model sees around the ego, before it thinks of what comes of it."""

    objects: list[SeenObject] = Field(description="The nearest first, at most 8.")


class Perception(Edges):
    """What the model sees around the ego."""

    objects: list[PerceivedObject] = Field(description="The nearest first, at most 8.")


class Prediction(ResponseModel):
    """Where the ego will be when the imagined picture is taken, in its frame of now."""

    x_m: Finite
    y_m: Finite
    direction: str = Field(description="Left, Forward or Right.")


class Picture(ResponseModel):
    """One of the n pictures; data of the event `picture`."""

    index: Index
    image: str = Field(description="PNG in base64, 224 x 112 pixels, painted of the codes.")
    codes: Annotated[
        list[int],
        Field(
            min_length=PICTURE_CODES,
            max_length=PICTURE_CODES,
            description="98 codes of 0..999, row by row from the upper left, 14 in a row.",
        ),
    ]


class ImaginedPicture(Picture):
    """One of the n pictures, and what the model said before it."""

    logprob: float = Field(
        le=0,
        allow_inf_nan=False,
        description="Natural logarithm of the probability of all codes, at the request's temperature (0 "
        "counts as 1), behind what was perceived and predicted.",
    )
    perception: Perception
    prediction: Prediction


class ImagineResponse(ResponseModel):
    """Answer of POST /v1/imagine."""

    request_id: str
    model: ModelName
    format: str = Field(description="The model's first format that imagines.")
    camera: Camera
    seconds: float = Field(description="How far ahead the pictures are.")
    pictures: list[ImaginedPicture]
    timing: Timing


class PerceptionWritten(ResponseModel):
    """Data of the event `perception`."""

    index: Index
    perception: Seen


class PredictionWritten(ResponseModel):
    """Data of the event `prediction`."""

    index: Index
    prediction: Prediction


class CodesWritten(ResponseModel):
    """Data of the event `codes`: how far the picture is written."""

    index: Index
    written: int = Field(ge=0, le=PICTURE_CODES, description="Whole rows of 14 codes; at last all 98.")


Event = PerceptionWritten | PredictionWritten | CodesWritten | Picture | Problem

EVENTS: Final[dict[str, type[Event]]] = {
    "perception": PerceptionWritten,
    "prediction": PredictionWritten,
    "codes": CodesWritten,
    "picture": Picture,
    "error": Problem,
}
"""Server-sent events and their data; `done` ends the stream with what the answer would have been without."""
