"""Planning for clients that speak OpenAI's chat completions: their requests and answers, without HTTP.

Pictures come as image parts, camera by camera in the order of the model card, each oldest first. What the
dialect has no words for (ego history, route, thinking, deadline) comes in a field ``looktwice``, and goes
back in a field of that name beside the message.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

import clients.wire as wire
from model.driving.scene import CLIP_FRAMES
from model.engines.engine import ModelCard
from service.answers import plan_answer
from service.planning import Planned
from service.problems import INVALID_CLIP, INVALID_IMAGE, INVALID_REQUEST, at

THINKING: Final = "Thinking: "
_EVERY: Final = 5
"""Poses of a trajectory between those that are told in a message: every half second."""
_DATA: Final = "data:"
_STANDING: Final = [[0.0, 0.0, 0.0, 0.0]] * 16


_Off = Annotated[float, Field(ge=0, le=0)] | None


def _null_is(default: float) -> BeforeValidator:
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


class Message(_Dialect):
    """One turn of the dialogue; only pictures of users matter."""

    role: Literal["system", "developer", "user", "assistant"]
    content: str | list[Annotated[ImagePart | TextPart, Field(discriminator="type")]]


class StreamOptions(_Dialect):
    """Of a streamed answer."""

    include_usage: bool = False


class Extras(wire.Asked):
    """What chat completions have no words for."""

    history: wire.History | None = Field(default=None, description="Without it the car is taken to stand.")
    route: wire.Route | None = None
    tracks: list[wire.Track] | None = Field(default=None, max_length=16)
    thinking: wire.Thinking = "adaptive"
    think_threshold: wire.Probability | None = None
    prefill: wire.PlanGiven | None = None
    deadline_ms: int | None = Field(default=None, ge=1, le=600_000)
    format: str = Field(default="cf_vla", max_length=40)


class ChatRequest(_Dialect):
    """Body of POST /v1/chat/completions, as far as it has a meaning here.

    Lengths of answers follow from the response format, so ``max_tokens`` says nothing; what would change
    an answer and cannot be obeyed is refused.
    """

    model: str = ""
    messages: list[Message] = Field(min_length=1, max_length=64)
    n: Annotated[int, _null_is(1), Field(ge=1, le=64)] = 1
    temperature: Annotated[float, _null_is(1.0), Field(ge=0, le=2)] = 1.0
    top_p: Annotated[float, _null_is(1.0), Field(gt=0, le=1)] = 1.0
    seed: Annotated[int, _null_is(0), Field(ge=0, le=wire.MAX_SEED)] = 0
    stream: bool = False
    stream_options: StreamOptions | None = None
    looktwice: Extras = Extras()
    stop: None = None
    tools: None = None
    response_format: None = None
    logprobs: Literal[False] | None = None
    presence_penalty: _Off = None
    frequency_penalty: _Off = None
    min_p: _Off = None
    top_k: Annotated[int, Field(ge=-1, le=0)] | None = None
    repetition_penalty: Annotated[float, Field(ge=1, le=1)] | None = None
    logit_bias: Annotated[dict[str, float], Field(max_length=0)] | None = None


def plan_request(chat: ChatRequest, card: ModelCard) -> wire.PlanRequest:
    """The request that a chat stands for; raises `ProblemError` where it is none."""
    if chat.model not in ("", card.name):
        raise at(INVALID_REQUEST, "/model", f"{chat.model!r} is not here; {card.name!r} is")
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
    controls = extras.model_dump(include={"thinking", "think_threshold", "prefill", "deadline_ms"})
    controls |= chat.model_dump(include={"n", "temperature", "top_p", "seed"})
    return wire.PlanRequest.model_validate(
        {
            "scene": {
                "clips": clips,
                "history": extras.history or _STANDING,
                "route": extras.route,
                "tracks": extras.tracks,
            },
            "controls": controls,
            "format": extras.format,
            "stream": chat.stream,
        }
    )


def _images(messages: Iterable[Message]) -> Iterable[str]:
    for number, message in enumerate(messages):
        if isinstance(message.content, str) or message.role != "user":
            continue
        for part, content in enumerate(message.content):
            if isinstance(content, ImagePart):
                head, comma, encoded = content.image_url.url.partition(",")
                if not (head.startswith(_DATA) and head.endswith(";base64") and comma):
                    pointer = f"/messages/{number}/content/{part}/image_url/url"
                    problem = "send pictures as data:image/jpeg;base64,…; nothing is fetched"
                    raise at(INVALID_IMAGE, pointer, problem)
                yield encoded


class Completion:
    """Makes the answers to one chat.

    Args:
        completion_id: of this answer.
        model: that answers.
        chat: what was asked.
    """

    def __init__(self, completion_id: str, model: str, chat: ChatRequest) -> None:
        self._chat = chat
        self._head = {
            "id": f"chatcmpl-{completion_id}",
            "created": int(time.time()),
            "model": model,
        }
        self._request_id = completion_id

    def whole(self, planned: Planned) -> dict[str, Any]:
        """The answer at once."""
        answer = plan_answer(planned, self._request_id)
        choices = [
            {
                "index": draw.index,
                "message": {"role": "assistant", "content": text_of(draw)} | self._extra(draw),
                "finish_reason": "stop",
                "logprobs": None,
            }
            for draw in answer.draws
        ]
        return self._head | {"object": "chat.completion", "choices": choices, "usage": _usage(planned)}

    def delta(self, index: int, text: str) -> dict[str, Any]:
        """More of one choice."""
        return self._chunk([{"index": index, "delta": {"role": "assistant", "content": text}}])

    def last(self, planned: Planned) -> list[dict[str, Any]]:
        """What ends a stream."""
        answer = plan_answer(planned, self._request_id)
        choices = [
            {"index": draw.index, "delta": self._extra(draw), "finish_reason": "stop"}
            for draw in answer.draws
        ]
        chunks = [self._chunk(choices)]
        options = self._chat.stream_options
        if options is not None and options.include_usage:
            chunks.append(self._chunk([]) | {"usage": _usage(planned)})
        return chunks

    def _chunk(self, choices: list[dict[str, Any]]) -> dict[str, Any]:
        return self._head | {"object": "chat.completion.chunk", "choices": choices}

    def _extra(self, draw: wire.Draw) -> dict[str, Any]:
        assumed = [] if self._chat.looktwice.history is not None else ["history"]
        return {"looktwice": draw.model_dump() | {"assumed": assumed}}


def text_of(draw: wire.Draw) -> str:
    """A draw as a message."""
    parts = [] if draw.plan is None else [draw.plan.text]
    if draw.thinking is not None and draw.revised_plan is not None:
        parts += [THINKING, draw.thinking, "\n", draw.revised_plan.text]
    return "".join([*parts, trajectory_text(draw.trajectory)])


def trajectory_text(trajectory: list[list[float]]) -> str:
    """A trajectory as a line of text: x and y in m, heading in rad, every half second."""
    told = trajectory[_EVERY - 1 :: _EVERY]
    rows = [[round(x, 2), round(y, 2), round(heading, 3)] for x, y, _, heading in told]
    return f"Trajectory: {json.dumps(rows)}\n"


def _usage(planned: Planned) -> dict[str, int]:
    written = sum(sum(draw.tokens.values()) for draw in planned.draws)
    prompt = planned.card.prompt_tokens
    return {"prompt_tokens": prompt, "completion_tokens": written, "total_tokens": prompt + written}
