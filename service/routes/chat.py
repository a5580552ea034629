"""POST /v1/chat/completions."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator
from contextlib import aclosing
from typing import Any, Final

from fastapi import APIRouter, Request
from starlette.responses import JSONResponse

import looktwice.clients.wire as wire
from looktwice.service.http.callers import while_connected
from looktwice.service.http.dialect import dialect_error
from looktwice.service.http.openapi import Responses, event_stream, problems
from looktwice.service.http.payloads import payload_route
from looktwice.service.http.problem_documents import validated
from looktwice.service.openai.chat_requests import ChatPlaces, ChatRequest, check_model, plan_document
from looktwice.service.openai.completions import Completion
from looktwice.service.planning.events import PlannedScene
from looktwice.service.planning.submitting import last
from looktwice.service.planning.telling import PlanTeller, Written
from looktwice.service.planning.validation import format_of
from looktwice.service.problems import (
    DRAINING,
    ENGINE_FAILED,
    NOT_READY,
    UNAUTHORIZED,
    UNKNOWN_MODEL,
    ProblemError,
)
from looktwice.service.routes.arrivals import arrival_of
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.routes.plan import REFUSALS
from looktwice.service.routes.streaming import streamed

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
            **event_stream("With stream: true. A chat completion chunk, or [DONE]."),
        }
    }
}


def chat_router(deps: Dependencies) -> APIRouter:
    """The endpoint for clients of OpenAI's API."""
    router = APIRouter(route_class=payload_route(lambda _: deps.planning.check_open()), tags=["planning"])

    refusals = problems(*REFUSALS, UNKNOWN_MODEL, dialect=True)

    @router.post("/v1/chat/completions", responses=refusals | _ANSWERS)
    async def chat_completions(request: Request, chat: ChatRequest) -> Any:
        """Planning in OpenAI's dialect: pictures as image parts, a message per draw; see docs/http.md."""
        arrival = arrival_of(request)
        card = deps.lifecycle.card
        completion, places = Completion(arrival.request_id, card.name, chat), ChatPlaces(chat)
        try:
            asked = validated(wire.PlanRequest, plan_document(chat, card))
            events = deps.planning.events(asked, arrival)
            if not chat.stream:
                planned = await while_connected(request, last(events))
                return JSONResponse(completion.whole(planned, PlanTeller(format_of(asked, card))))
            return await streamed(
                request,
                events,
                lambda: PlanTeller(format_of(asked, card)),
                lambda told: _chunks(told, completion, places),
                deps.metrics,
            )
        except ProblemError as problem:
            raise places.problem(problem) from problem

    @router.get(
        "/v1/models/{name}",
        responses=problems(*(UNAUTHORIZED, UNKNOWN_MODEL, NOT_READY, DRAINING, ENGINE_FAILED), dialect=True),
    )
    async def model(name: str) -> wire.NamedModel:
        """One model, in OpenAI's dialect."""
        deps.lifecycle.check_ready()
        card = deps.lifecycle.card
        check_model(name, card)
        return wire.NamedModel(id=card.name, created=deps.began_s)

    return router


async def _chunks(
    told: AsyncGenerator[tuple[str, Written] | PlannedScene], completion: Completion, places: ChatPlaces
) -> AsyncGenerator[bytes]:
    async with aclosing(told):
        try:
            async for event in told:
                if isinstance(event, PlannedScene):
                    for chunk in completion.last(event):
                        yield _data(chunk)
                elif (delta := completion.delta(*event)) is not None:
                    yield _data(delta)
        except ProblemError as error:
            yield _data({"error": dialect_error(places.problem(error))})
    yield b"data: [DONE]\n\n"


def _data(chunk: dict[str, Any]) -> bytes:
    return f"data: {json.dumps(chunk)}\n\n".encode()
