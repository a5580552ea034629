"""What all of the contract is made of: names, numbers, and the bases of requests and answers."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, Field

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
AgentKind = Literal["vehicle", "pedestrian", "cone", "barrier"]
Light = Literal["brake", "left", "right"]
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
    Field(
        description="When the poses of the trajectory are, in s from now; null for 64 at 10 Hz.",
        fail_fast=True,
    ),
]


class _Timed(Protocol):
    trajectory: Poses
    times_s: TimesS


_TimedAnswer = TypeVar("_TimedAnswer", bound=_Timed)


def check_times(answer: _TimedAnswer) -> _TimedAnswer:
    """Raise `ValueError` where there are more or fewer poses than times."""
    poses = 64 if answer.times_s is None else len(answer.times_s)
    if len(answer.trajectory) != poses:
        raise ValueError(f"a trajectory of {poses} poses is told, and {len(answer.trajectory)} are there")
    return answer


class RequestModel(BaseModel):
    """Base of everything a caller sends: unknown fields are refused."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")


class ResponseModel(BaseModel):
    """Base of everything the service sends: readers ignore fields they do not know."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore")


class ModelName(ResponseModel):
    """Which weights answered."""

    name: str
    revision: str = Field(description="Changes with the weights, the codec and the codes of pictures.")
