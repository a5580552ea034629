"""The contract of GET /v1/models and POST /v1/models:load."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from looktwice.clients.wire.base import RequestModel, ResponseModel
from looktwice.clients.wire.controls import Thinking
from looktwice.clients.wire.label import TeacherName


class ModelCard(ResponseModel):
    """What a loaded checkpoint is."""

    name: str
    revision: str = Field(description="Changes with the weights, the codec and the codes of pictures.")
    engine: str = Field(description="torch, vllm or transformers.")
    formats: list[str] = Field(description="Response formats it writes.")
    reflects: list[str] = Field(
        default_factory=list,
        description="Of these, the ones that may look twice at a plan, as POST /v1/reflect asks.",
    )
    refines: list[str] = Field(
        default_factory=list, description="Of these, the ones that refine an attempt, which they need."
    )
    imagines: list[str] = Field(
        default_factory=list, description="Of these, the ones that may imagine a picture half a second ahead."
    )
    paints: bool = Field(
        default=False, description="Whether it can paint what it imagines, as POST /v1/imagine asks."
    )
    thinking: dict[str, list[Thinking]] = Field(
        default_factory=dict,
        description="What `thinking` may be in each format. A `think_threshold` has a meaning in those that "
        "may be told `always`.",
    )
    deadlines: bool = Field(default=True, description="Whether it keeps deadlines (`deadline_ms`).")
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

    def thinking_in(self, format: str | None) -> list[Thinking]:
        """What `thinking` may be in a format, the model's first without one; anything where none is told."""
        name = next(iter(self.formats), "") if format is None else format
        return self.thinking.get(name, list(get_args(Thinking)))


class NamedModel(ResponseModel):
    """A model as clients of OpenAI's API expect it."""

    id: str
    object: Literal["model"] = "model"
    created: int = Field(description="When the service began, in s since 1970.")
    owned_by: str = "looktwice"


class ModelList(ResponseModel):
    """Answer of GET /v1/models; `object` and `data` are for clients of OpenAI's API."""

    object: Literal["list"] = "list"
    data: list[NamedModel] = Field(default_factory=list)

    models: list[ModelCard]
    teacher: TeacherName | None = Field(
        default=None, description="Who writes the labels of POST /v1/label; null where nobody does."
    )


class LoadRequest(RequestModel):
    """Body of POST /v1/models:load."""

    checkpoint: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$", description="Name of a folder among the checkpoints."
    )
