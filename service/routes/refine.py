"""POST /v1/refine."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, Request
from fastapi.openapi.models import Example
from starlette.responses import Response

import looktwice.clients.wire_refine as wire_refine
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.service.http.callers import while_connected
from looktwice.service.http.idempotency import IdempotencyKey, once, refuse_key
from looktwice.service.http.openapi import answers_and_stream, payloads, problems
from looktwice.service.http.payloads import payload_route, respond
from looktwice.service.planning.events import PlannedScene
from looktwice.service.planning.refining import RefineTeller, Refining, refine_answer, refining_of
from looktwice.service.planning.submitting import last
from looktwice.service.problems import INVALID_FEEDBACK, INVALID_TRAJECTORY, NEEDS_TRACKS, OTHER_PLAN
from looktwice.service.routes.arrivals import arrival_of
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.routes.plan import REFUSALS
from looktwice.service.routes.request_examples import example_refinement, example_taught_refinement
from looktwice.service.routes.streaming import server_sent, streamed

_CAMERAS: Final = (FRONT_WIDE, FRONT_TELE)
_DRAFT: Final = example_refinement(_CAMERAS)
EXAMPLES: Final[dict[str, Example]] = {
    "a draft that does not brake": {"value": _DRAFT},
    "the same, told as it is refined": {"value": _DRAFT | {"stream": True}},
    "the same with feedback that was written for it": {"value": example_taught_refinement(_CAMERAS)},
}


def refine_router(deps: Dependencies) -> APIRouter:
    """The endpoint; refinements take places as draws of /v1/plan do."""
    router = APIRouter(route_class=payload_route(deps.check_planning), tags=["planning"])
    refusals = problems(*REFUSALS, INVALID_TRAJECTORY, INVALID_FEEDBACK, NEEDS_TRACKS, OTHER_PLAN)

    @router.post(
        "/v1/refine",
        response_model=wire_refine.RefineResponse,
        responses=refusals | answers_and_stream(*wire_refine.EVENTS),
        openapi_extra=payloads(wire_refine.RefineRequest),
    )
    async def refine(
        request: Request,
        asked: Annotated[wire_refine.RefineRequest, Body(openapi_examples=EXAMPLES)],
        idempotency_key: IdempotencyKey = None,
    ) -> Any:
        """A draft and feedback on it: n refinements, with scores before and after by the sent objects."""
        arrival = arrival_of(request)

        async def begin() -> Refining:
            # On a thread: numbers of a few ms must not hold up the answers of others.
            return await asyncio.to_thread(refining_of, asked, deps.lifecycle.card, arrival.request_id)

        async def answer(refining: Refining, planned: PlannedScene) -> wire_refine.RefineResponse:
            told = refining.judged.feedback
            if told.correct is not None:
                deps.metrics.count_feedback(told.written_by, correct=told.correct)
            return await asyncio.to_thread(refine_answer, refining, planned, arrival)

        async def work() -> Response:
            refining = await begin()
            planned = await last(deps.planning.events(refining.planning, arrival, refining.geometry))
            return respond(request, await answer(refining, planned))

        if not asked.stream:
            return await once(request, deps.idempotency, idempotency_key, asked, work)
        refuse_key(idempotency_key)
        refining = await while_connected(request, begin())
        return await streamed(
            request,
            deps.planning.events(refining.planning, arrival, refining.geometry),
            lambda: RefineTeller(refining),
            lambda told: server_sent(told, lambda planned: answer(refining, planned), arrival.request_id),
            deps.metrics,
        )

    return router
