"""POST /v1/refine."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, Request
from fastapi.openapi.models import Example

import clients.wire_refine as wire_refine
from model.driving.scene import FRONT_TELE, FRONT_WIDE
from service.callers import while_connected
from service.examples import example_refinement
from service.openapi import PACKED, payloads, problems
from service.parts import Parts
from service.payloads import payload_route
from service.planning import last
from service.planning_routes import REFUSALS, arrival_of, respond
from service.problems import INVALID_FEEDBACK, INVALID_TRAJECTORY, NEEDS_TRACKS
from service.refining import refine_answer, refining_of

EXAMPLES: Final[dict[str, Example]] = {
    "a draft that does not brake": {"value": example_refinement((FRONT_WIDE, FRONT_TELE))}
}


def refine_router(parts: Parts) -> APIRouter:
    """The endpoint; refinements take places as draws of /v1/plan do."""
    router = APIRouter(route_class=payload_route(lambda _: parts.planning.check_open()), tags=["planning"])

    @router.post(
        "/v1/refine",
        response_model=wire_refine.RefineResponse,
        responses=problems(*REFUSALS, INVALID_TRAJECTORY, INVALID_FEEDBACK, NEEDS_TRACKS) | PACKED,
        openapi_extra=payloads(wire_refine.RefineRequest),
    )
    async def refine(
        request: Request, asked: Annotated[wire_refine.RefineRequest, Body(openapi_examples=EXAMPLES)]
    ) -> Any:
        """A draft and feedback on it: n refinements, with scores before and after by the sent objects."""
        arrival = arrival_of(request)

        async def work() -> wire_refine.RefineResponse:
            # On a thread: numbers of a few ms must not hold up the answers of others.
            refining = await asyncio.to_thread(refining_of, asked, parts.lifecycle.card)
            planned = await last(parts.planning.events(refining.planning, arrival))
            told = refining.feedback
            if told.correct is not None:
                parts.metrics.feedback_told(told.written_by, correct=told.correct)
            return await asyncio.to_thread(refine_answer, refining, planned, arrival)

        return respond(request, await while_connected(request, work()))

    return router
