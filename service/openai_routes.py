"""POST /v1/chat/completions."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator
from contextlib import aclosing
from typing import Any, Final

from fastapi import APIRouter, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.responses import JSONResponse

import clients.wire as wire
from service.callers import while_connected
from service.errors import from_validation, problem_document
from service.openai_chat import THINKING, ChatRequest, Completion, plan_request, trajectory_text
from service.openapi import Responses, problems
from service.parts import Parts
from service.payloads import payload_route
from service.planning import Planned, last
from service.planning_routes import REFUSALS, arrival_of
from service.problems import ProblemError
from service.streaming import Told, Written, streamed

_ANSWERS: Final[Responses] = {
    200: {
        "content": {
            "application/json": {
                "schema": {
                    "type": "object",
                    "description": "A chat completion; each message has a `looktwice` with its draw.",
                    "required": ["id", "object", "created", "model", "choices", "usage"],
                    "properties": {
                        "object": {"const": "chat.completion"},
                        "choices": {"type": "array", "minItems": 1, "items": {"type": "object"}},
                    },
                }
            },
            wire.SSE_MEDIA_TYPE: {
                "schema": {"type": "string", "description": "With stream: true. Chat completion chunks."}
            },
        }
    }
}


def openai_router(parts: Parts) -> APIRouter:
    """The endpoint for clients of OpenAI's API."""
    router = APIRouter(route_class=payload_route(lambda _: parts.planning.check_open()), tags=["planning"])

    @router.post("/v1/chat/completions", responses=problems(*REFUSALS) | _ANSWERS)
    async def chat_completions(request: Request, chat: ChatRequest) -> Any:
        """Planning in OpenAI's dialect: pictures as image parts, a message per draw; see docs/http.md."""
        arrival = arrival_of(request)
        card = parts.lifecycle.card
        try:
            asked = plan_request(chat, card)
        except ValidationError as error:
            raise from_validation(RequestValidationError(error.errors())) from None
        completion = Completion(arrival.request_id, card.name, chat)
        events = parts.planning.events(asked, arrival)
        if not chat.stream:
            return JSONResponse(completion.whole(await while_connected(request, last(events))))
        return await streamed(
            request, events, lambda told: _chunks(told, completion, arrival.request_id), parts.metrics
        )

    return router


async def _chunks(
    told: AsyncGenerator[Told], completion: Completion, request_id: str
) -> AsyncGenerator[bytes]:
    async with aclosing(told):
        try:
            async for event in told:
                if isinstance(event, Planned):
                    for chunk in completion.last(event):
                        yield _data(chunk)
                elif (text := _text(*event)) is not None:
                    yield _data(completion.delta(event[1].index, text))
        except ProblemError as error:
            yield _data({"error": problem_document(error, request_id).model_dump()})
    yield b"data: [DONE]\n\n"


def _text(name: str, data: Written) -> str | None:
    """What an event adds to a message; see `text_of`."""
    match data:
        case wire.PlanWritten():
            return f"\n{data.plan.text}" if name == "revised_plan" else data.plan.text
        case wire.BranchTaken(branch="Thinking:"):
            return THINKING
        case wire.ThinkingWritten():
            return data.text
        case wire.TrajectoryWritten() if name == "trajectory":
            return trajectory_text(data.trajectory)
    return None


def _data(chunk: dict[str, Any]) -> bytes:
    return f"data: {json.dumps(chunk)}\n\n".encode()
