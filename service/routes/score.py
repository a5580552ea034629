"""POST /v1/score and /v1/score/batch; they need no model."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, Request
from fastapi.openapi.models import Example

import looktwice.clients.wire_scores as wire_scores
from looktwice.service.admission.places import Admission, let_in
from looktwice.service.http.callers import while_connected
from looktwice.service.http.openapi import PACKED, payloads, problems
from looktwice.service.http.payloads import payload_route, respond
from looktwice.service.http.problem_documents import validated
from looktwice.service.planning.events import Arrival
from looktwice.service.problems import (
    BODY_TIMEOUT,
    BODY_TOO_LARGE,
    DRAINING,
    INVALID_BODY,
    INVALID_JSON,
    INVALID_LABELS,
    INVALID_REQUEST,
    INVALID_TRAJECTORY,
    QUEUE_FULL,
    RATE_LIMITED,
    SCENES_UNREADABLE,
    UNAUTHORIZED,
    UNKNOWN_FIELD,
    UNKNOWN_SCENE,
    UNSUPPORTED_MEDIA_TYPE,
)
from looktwice.service.routes.arrivals import arrival_of
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.routes.request_examples import example_score, example_score_batch

EXAMPLES: Final[dict[str, Example]] = {"straight on behind a car": {"value": example_score()}}
BATCH_EXAMPLES: Final[dict[str, Example]] = {
    "the same by the rules of both versions": {"value": example_score_batch()}
}
SCORING_REFUSALS: Final = (
    *(INVALID_JSON, INVALID_BODY, UNAUTHORIZED, BODY_TIMEOUT, BODY_TOO_LARGE, UNSUPPORTED_MEDIA_TYPE),
    *(INVALID_REQUEST, UNKNOWN_FIELD, INVALID_LABELS, INVALID_TRAJECTORY, UNKNOWN_SCENE),
    *(QUEUE_FULL, RATE_LIMITED, SCENES_UNREADABLE, DRAINING),
)


def score_router(deps: Dependencies, admission: Admission) -> APIRouter:
    """The endpoints of the scorer; ``admission`` bounds how many requests it has."""

    async def result(given: Any, arrival: Arrival) -> wire_scores.ScoreResult:
        try:
            asked = await asyncio.to_thread(validated, wire_scores.ScoreRequest, given)
            return wire_scores.ScoreResult(
                status=200, response=await deps.scorer.score(asked, arrival.request_id)
            )
        except Exception as error:
            problem = deps.problem_within(error, arrival.request_id)
        return wire_scores.ScoreResult(status=problem.status, problem=problem)

    router = APIRouter(route_class=payload_route(lambda _: deps.check_open(admission)), tags=["scoring"])
    refusals = problems(*SCORING_REFUSALS)

    @router.post(
        "/v1/score",
        response_model=wire_scores.ScoreResponse,
        responses=refusals | PACKED,
        openapi_extra=payloads(wire_scores.ScoreRequest),
    )
    async def score(
        request: Request, asked: Annotated[wire_scores.ScoreRequest, Body(openapi_examples=EXAMPLES)]
    ) -> Any:
        """What trajectories are worth by NAVSIM's rules: sub-scores, and why each one fails."""
        arrival = arrival_of(request)
        with deps.lifecycle.accepted(), let_in(admission.place(1)):
            await deps.planning.spend(arrival.owner, 1)
            scoring = deps.scorer.score(asked, arrival.request_id)
            return respond(request, await while_connected(request, scoring))

    @router.post(
        "/v1/score/batch",
        response_model=wire_scores.ScoreBatchResponse,
        responses=refusals | PACKED,
        openapi_extra=payloads(wire_scores.ScoreBatchRequest),
    )
    async def batch(
        request: Request,
        asked: Annotated[wire_scores.ScoreBatchRequest, Body(openapi_examples=BATCH_EXAMPLES)],
    ) -> Any:
        """Many scenes at once: each gets its scores or its problem."""
        arrival = arrival_of(request)

        async def work() -> wire_scores.ScoreBatchResponse:
            return wire_scores.ScoreBatchResponse(
                results=[await result(each, arrival) for each in asked.requests]
            )

        with deps.lifecycle.accepted(), let_in(admission.place(1)):
            await deps.planning.spend(arrival.owner, len(asked.requests))
            return respond(request, await while_connected(request, work()))

    return router
