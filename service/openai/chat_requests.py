"""Requests of clients that speak OpenAI's chat completions.

Pictures come as image parts, camera by camera in the order of the model card, each oldest first. What the
dialect has no words for (ego history, route, thinking, deadline) comes in a field ``looktwice``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

import looktwice.clients.wire as wire
from looktwice.model.driving.scene import CLIP_FRAMES
from looktwice.model.network.model_card import ModelCard
from looktwice.service.problems import (
    INVALID_CLIP,
    INVALID_IMAGE,
    INVALID_REQUEST,
    UNKNOWN_MODEL,
    ProblemError,
    at,
)

_DATA: Final = "data:"
_STANDING: Final = [[0.0, 0.0, 0.0, 0.0]] * 16


_HARMLESS: Final[Mapping[str, Sequence[object]]] = {
    **dict.fromkeys(("stop", "stop_token_ids", "bad_words"), (None, [], "")),
    **dict.fromkeys(("tools", "functions"), (None, [])),
    **dict.fromkeys(("tool_choice", "function_call"), (None, "none", "auto")),
    **dict.fromkeys(("presence_penalty", "frequency_penalty", "min_p", "min_tokens"), (None, 0)),
    **dict.fromkeys(("repetition_penalty", "length_penalty", "best_of"), (None, 1)),
    **dict.fromkeys(("logprobs", "echo", "use_beam_search", "continue_final_message"), (None, False)),
    **dict.fromkeys(("top_logprobs", "prompt_logprobs"), (None, 0)),
    **dict.fromkeys(("guided_json", "guided_regex", "guided_choice", "guided_grammar"), (None,)),
    **dict.fromkeys(("structured_outputs", "allowed_token_ids", "audio", "prediction"), (None,)),
    "top_k": (None, 0, -1),
    "logit_bias": (None, {}),
    "response_format": (None, {"type": "text"}),
    "modalities": (None, ["text"]),
}
"""Fields of OpenAI's and vLLM's dialects that would change an answer, and the values that change nothing."""


def _null_is(default: object) -> BeforeValidator:
    """Clients send null for what they leave to the server."""
    return BeforeValidator(lambda value: default if value is None else value)


class _Dialect(BaseModel):
    """Other dialects' fields are let pass: clients send many."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class ImageUrl(_Dialect):
    """Where a picture is: within the request, as a data URL."""

    url: str


class ImagePart(_Dialect):
    """A picture of a message."""

    type: Literal["image_url"]
    image_url: ImageUrl


class TextPart(_Dialect):
    """Text of a message; the model does not read it."""

    type: Literal["text"]
    text: str = Field(max_length=100_000)


_Parts = Annotated[
    list[Annotated[ImagePart | TextPart, Field(discriminator="type")]],
    Field(max_length=256, fail_fast=True),
]
"""Of a message: four pictures of each camera, and text between them."""


class Message(_Dialect):
    """One turn of the dialogue; only pictures of users matter."""

    role: Literal["system", "developer", "user", "assistant"]
    content: str | _Parts | None


class StreamOptions(_Dialect):
    """Of a streamed answer."""

    include_usage: Annotated[bool, _null_is(False)] = False


class Extras(wire.RequestModel):
    """What chat completions have no words for."""

    history: wire.History | None = Field(default=None, description="Without it the car is taken to stand.")
    route: wire.Route | None = None
    tracks: list[wire.Track] | None = Field(default=None, max_length=16)
    thinking: wire.Thinking = "adaptive"
    think_threshold: wire.Probability | None = None
    prefill: wire.PlanGiven | None = None
    deadline_ms: int | None = Field(default=None, ge=1, le=600_000)
    numbers: wire.Decision = "least_error"
    codes: wire.Decision = "least_error"
    bind: bool = False
    reasons: wire.Reasons = "in_view"
    logprobs: bool = False
    format: str | None = Field(default=None, max_length=40)


class ChatRequest(_Dialect):
    """Body of POST /v1/chat/completions, as far as it has a meaning here.

    Lengths of answers follow from the response format, so ``max_tokens`` says nothing; what would change
    an answer and cannot be obeyed is refused, see `plan_document`.
    """

    model_config = ConfigDict(frozen=True, extra="allow")

    model: str = ""
    messages: list[Message] = Field(min_length=1, max_length=64)
    n: Annotated[int, _null_is(1), Field(ge=1, le=64)] = 1
    temperature: Annotated[float, _null_is(1.0), Field(ge=0, le=2)] = 1.0
    top_p: Annotated[float, _null_is(1.0), Field(gt=0, le=1)] = 1.0
    seed: Annotated[int, _null_is(0), Field(ge=0, le=wire.MAX_SEED)] = 0
    stream: Annotated[bool, _null_is(False)] = False
    stream_options: StreamOptions | None = None
    looktwice: Annotated[Extras, _null_is(Extras())] = Extras()


def plan_document(chat: ChatRequest, card: ModelCard) -> dict[str, Any]:
    """The plan request that a chat stands for, not yet checked.

    Raises:
        ProblemError: it asks for what cannot be obeyed, or brings other pictures than the model takes.
    """
    check_model(chat.model, card)
    for name, value in (chat.model_extra or {}).items():
        if value not in _HARMLESS.get(name, [value]):
            raise at(INVALID_REQUEST, f"/{name}", "this cannot be obeyed here; leave it out")
    images = list(_images(chat.messages))
    wanted = CLIP_FRAMES * len(card.cameras)
    if len(images) != wanted:
        cameras = ", then ".join(card.cameras)
        problem = f"{len(images)} pictures; needed are {wanted}: {CLIP_FRAMES} of {cameras}, oldest first"
        raise at(INVALID_CLIP, "/messages", problem)
    extras = chat.looktwice
    clips = [
        {"camera": camera, "images": images[CLIP_FRAMES * number :][:CLIP_FRAMES]}
        for number, camera in enumerate(card.cameras)
    ]
    controls = extras.model_dump(exclude={"history", "route", "tracks", "format"})
    controls |= chat.model_dump(include={"n", "temperature", "top_p", "seed"})
    scene = {"clips": clips, "history": extras.history or _STANDING, "route": extras.route}
    if extras.tracks is not None:
        scene["tracks"] = [track.model_dump() for track in extras.tracks]
    return {"scene": scene, "controls": controls, "format": extras.format, "stream": chat.stream}


def check_model(name: str, card: ModelCard) -> None:
    """Raise `ProblemError` where another model is asked for than the one that answers."""
    if name not in ("", card.name):
        raise at(UNKNOWN_MODEL, "/model", f"{name[:100]!r} is not here; {card.name!r} is")


class ChatPlaces:
    """Where in a chat stands what a plan request has elsewhere."""

    def __init__(self, chat: ChatRequest) -> None:
        self._pictures = [
            f"/messages/{number}/content/{part}/image_url/url"
            for number, message in enumerate(chat.messages)
            if message.role == "user" and isinstance(message.content, list)
            for part, content in enumerate(message.content)
            if isinstance(content, ImagePart)
        ]

    def problem(self, problem: ProblemError) -> ProblemError:
        """A problem of a plan request, told of the chat that it was made of."""
        detail, faults = problem.detail, []
        for fault in problem.errors:
            pointer = self._pointer(fault.pointer)
            if fault.pointer:
                detail = detail.replace(fault.pointer, pointer)
            faults.append(fault.model_copy(update={"pointer": pointer}))
        return ProblemError(problem.kind, detail, faults, problem.retry_after_s)

    def _pointer(self, pointer: str) -> str:
        match pointer.split("/")[1:]:
            case ["scene", "clips", camera, "images", number, *_] if camera.isdigit() and number.isdigit():
                place = CLIP_FRAMES * int(camera) + int(number)
                return self._pictures[place] if place < len(self._pictures) else "/messages"
            case ["scene", "clips", *_]:
                return "/messages"
            case ["controls", ("n" | "temperature" | "top_p" | "seed") as name, *_]:
                return f"/{name}"
            case ["controls" | "scene", *rest]:
                return "/".join(["/looktwice", *rest])
            case ["format" | "attempt", *_]:  # a chat has no attempt, but may name a format that needs one
                return "/looktwice/format"
        return pointer


def _images(messages: Iterable[Message]) -> Iterable[str]:
    for number, message in enumerate(messages):
        if not isinstance(message.content, list) or message.role != "user":
            continue
        for part, content in enumerate(message.content):
            if isinstance(content, ImagePart):
                head, comma, encoded = content.image_url.url.partition(",")
                if not (head.startswith(_DATA) and head.endswith(";base64") and comma):
                    pointer = f"/messages/{number}/content/{part}/image_url/url"
                    problem = "send pictures as data:image/jpeg;base64,…; nothing is fetched"
                    raise at(INVALID_IMAGE, pointer, problem)
                yield encoded
