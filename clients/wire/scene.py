"""What a planner sees at one instant, as every endpoint takes it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Discriminator, Field, Tag, WithJsonSchema

from looktwice.clients.wire.base import (
    AgentKind,
    Camera,
    Finite,
    History,
    Length,
    Light,
    Nearby,
    RequestModel,
    Route,
)


def _form_of_image(value: object) -> str:
    return "bytes" if isinstance(value, bytes) else "base64"


Image = Annotated[
    Annotated[str, Tag("base64")] | Annotated[bytes, Tag("bytes")],
    Discriminator(_form_of_image),
    WithJsonSchema({"type": "string"}),
]
"""A picture: base64 in JSON, bytes in msgpack and multipart bodies."""


class Clip(RequestModel):
    """Four pictures of one camera over the past 2 s."""

    camera: Camera = Field(description="Which camera.")
    images: list[Image] = Field(
        min_length=4,
        max_length=4,
        description="4 pictures at 2 Hz, oldest first: JPEG, PNG or WebP, at most 4 megapixels each; "
        "in base64 without a data: prefix, in msgpack as bytes, in multipart bodies as cid:NAME of a part.",
    )


class Track(RequestModel):
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


class Scene(RequestModel):
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
