"""POST /v1/plan, /v1/plan/batch and /v1/reflect."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, Request
from fastapi.openapi.models import Example
from pydantic import BaseModel
from starlette.responses import Response

import looktwice.clients.wire as wire
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.service.http.idempotency import IdempotencyKey, NotCached, once, refuse_key
from looktwice.service.http.openapi import PACKED, answers_and_stream, payloads, problems
from looktwice.service.http.payloads import payload_route, respond
from looktwice.service.http.problem_documents import validated
from looktwice.service.planning.events import Arrival, PlannedScene
from looktwice.service.planning.submitting import AnyPlanRequest, last
from looktwice.service.planning.telling import PlanTeller
from looktwice.service.planning.validation import format_of
from looktwice.service.planning.wire_answers import plan_answer, reflect_answer
from looktwice.service.problems import (
    BODY_TIMEOUT,
    BODY_TOO_LARGE,
    DECODE_TIMEOUT,
    DRAINING,
    ENGINE_FAILED,
    IDEMPOTENCY_KEY_REUSED,
    INVALID_ATTEMPT,
    INVALID_BODY,
    INVALID_CLIP,
    INVALID_CONTROLS,
    INVALID_HISTORY,
    INVALID_IMAGE,
    INVALID_JSON,
    INVALID_PLAN,
    INVALID_REQUEST,
    INVALID_ROUTE,
    INVALID_TRACKS,
    MISSING_CAMERA,
    NOT_READY,
    QUEUE_FULL,
    QUEUE_TIMEOUT,
    RATE_LIMITED,
    REFUSED,
    UNAUTHORIZED,
    UNKNOWN_CAMERA,
    UNKNOWN_FIELD,
    UNKNOWN_FORMAT,
    UNSUPPORTED_MEDIA_TYPE,
    ProblemError,
    at,
)
from looktwice.service.routes.arrivals import arrival_of
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.routes.request_examples import example_reflection, example_request
from looktwice.service.routes.streaming import server_sent, streamed

_TRY_AGAIN: Final = frozenset((429, 500, 503, 504))
"""What a scene of a batch may get that another try may better."""
PLAN_EXAMPLES: dict[str, Example] = {"straight on": {"value": example_request((FRONT_WIDE, FRONT_TELE))}}
REFLECT_EXAMPLES: dict[str, Example] = {
    "is it right to go on?": {"value": example_reflection((FRONT_WIDE, FRONT_TELE))}
}
REFUSALS = (
    *(INVALID_JSON, INVALID_BODY, UNAUTHORIZED, BODY_TIMEOUT, BODY_TOO_LARGE, UNSUPPORTED_MEDIA_TYPE),
    *(INVALID_REQUEST, UNKNOWN_FIELD, INVALID_CLIP, UNKNOWN_CAMERA, MISSING_CAMERA, INVALID_IMAGE),
    *(INVALID_HISTORY, INVALID_ROUTE, INVALID_TRACKS, INVALID_CONTROLS, INVALID_PLAN, INVALID_ATTEMPT),
    *(UNKNOWN_FORMAT, REFUSED),
    *(IDEMPOTENCY_KEY_REUSED, QUEUE_FULL, RATE_LIMITED, NOT_READY, DRAINING, ENGINE_FAILED),
    *(QUEUE_TIMEOUT, DECODE_TIMEOUT),
)


def plan_router(deps: Dependencies) -> APIRouter:
    """The endpoints that the engine works for."""
    router = APIRouter(route_class=payload_route(deps.check_planning), tags=["planning"])
    check_batch = partial(deps.check_planning, batch=True)
    batches = APIRouter(route_class=payload_route(check_batch), tags=["planning"])
    refusals = problems(*REFUSALS)

    @router.post(
        "/v1/plan",
        response_model=wire.PlanResponse,
        responses=refusals | answers_and_stream(*wire.EVENTS),
        openapi_extra=payloads(wire.PlanRequest),
    )
    async def plan(
        request: Request,
        asked: Annotated[wire.PlanRequest, Body(openapi_examples=PLAN_EXAMPLES)],
        idempotency_key: IdempotencyKey = None,
    ) -> Any:
        """One scene: per draw a plan, the branch, a second look where one was taken, a trajectory."""
        return await _one(request, deps, asked, idempotency_key, plan_answer)

    @router.post(
        "/v1/reflect",
        response_model=wire.ReflectResponse,
        responses=refusals | answers_and_stream(*wire.EVENTS),
        openapi_extra=payloads(wire.ReflectRequest),
    )
    async def reflect(
        request: Request,
        asked: Annotated[wire.ReflectRequest, Body(openapi_examples=REFLECT_EXAMPLES)],
        idempotency_key: IdempotencyKey = None,
    ) -> Any:
        """A second look at a given plan: keep it or revise it, why, and the trajectory that follows."""
        return await _one(request, deps, asked, idempotency_key, reflect_answer)

    @batches.post(
        "/v1/plan/batch",
        response_model=wire.BatchResponse,
        responses=refusals | PACKED,
        openapi_extra=payloads(wire.BatchRequest),
    )
    async def batch(
        request: Request, asked: wire.BatchRequest, idempotency_key: IdempotencyKey = None
    ) -> Any:
        """Many scenes at once: each gets its answer or its problem; those that do not fit yet wait."""
        # On a thread: a scene may have thousands of faults, and there may be 64 of them.
        scenes = await asyncio.to_thread(lambda: [_scene_of_batch(each) for each in asked.requests])
        for number, each in enumerate(scenes):
            if isinstance(each, wire.PlanRequest) and each.stream:
                raise at(INVALID_CONTROLS, f"/requests/{number}/stream", "a batch cannot stream")
        arrival = arrival_of(request)

        async def work() -> Response:
            with deps.planning.batch(len(scenes)):
                draws = sum(each.controls.n for each in scenes if isinstance(each, wire.PlanRequest))
                await deps.planning.spend(arrival.owner, draws)
                async with asyncio.TaskGroup() as group:
                    tasks = [group.create_task(_result(deps, each, arrival)) for each in scenes]
            results = [task.result() for task in tasks]
            answer = respond(request, wire.BatchResponse(results=results))
            if any(result.status in _TRY_AGAIN for result in results):
                raise NotCached(answer)
            return answer

        return await once(request, deps.idempotency, idempotency_key, asked, work)

    router.include_router(batches)
    return router


async def _one(
    request: Request,
    deps: Dependencies,
    asked: AnyPlanRequest,
    idempotency_key: str | None,
    made: Callable[[PlannedScene, str], BaseModel],
) -> Response:
    arrival = arrival_of(request)

    def answer(planned: PlannedScene) -> BaseModel:
        return made(planned, arrival.request_id)

    if asked.stream:
        refuse_key(idempotency_key)

        async def done(planned: PlannedScene) -> BaseModel:
            return answer(planned)

        return await streamed(
            request,
            deps.planning.events(asked, arrival),
            lambda: PlanTeller(format_of(asked, deps.lifecycle.card)),
            lambda told: server_sent(told, done, arrival.request_id),
            deps.metrics,
        )

    async def work() -> Response:
        return respond(request, answer(await last(deps.planning.events(asked, arrival))))

    return await once(request, deps.idempotency, idempotency_key, asked, work)


def _scene_of_batch(given: Any) -> wire.PlanRequest | ProblemError:
    """A request of a batch, or what is wrong with it."""
    try:
        return validated(wire.PlanRequest, given)
    except ProblemError as problem:
        return problem


async def _result(
    deps: Dependencies, asked: wire.PlanRequest | ProblemError, arrival: Arrival
) -> wire.BatchResult:
    try:
        if isinstance(asked, ProblemError):
            raise asked
        planned = await deps.planning.in_turn(asked, arrival)
        return wire.BatchResult(status=200, response=plan_answer(planned, arrival.request_id))
    except Exception as error:
        problem = deps.problem_within(error, arrival.request_id)
    return wire.BatchResult(status=problem.status, problem=problem)
