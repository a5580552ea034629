"""POST /v1/imagine."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, Request
from fastapi.openapi.models import Example

import looktwice.clients.wire_imagine as wire_imagine
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.service.http.callers import while_connected
from looktwice.service.http.openapi import answers_and_stream, payloads, problems
from looktwice.service.http.payloads import payload_route, respond
from looktwice.service.planning.events import PlannedScene
from looktwice.service.planning.imagining import ImagineTeller, imagine_answer, imagining_of
from looktwice.service.planning.submitting import last
from looktwice.service.problems import CANNOT_IMAGINE, INVALID_TRAJECTORY
from looktwice.service.routes.arrivals import arrival_of
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.routes.plan import REFUSALS
from looktwice.service.routes.request_examples import example_imagining, example_trajectory
from looktwice.service.routes.streaming import server_sent, streamed

EXAMPLES: Final[dict[str, Example]] = {
    "what the left camera will see": {"value": example_imagining((FRONT_WIDE, FRONT_TELE))},
    "the same, told as it is written": {
        "value": example_imagining((FRONT_WIDE, FRONT_TELE)) | {"stream": True}
    },
    "what it would see if the car moved so": {
        "value": example_imagining((FRONT_WIDE, FRONT_TELE))
        | {"motion": {"x_m": 4.5, "y_m": 0.2, "heading_rad": 0.1}}
    },
    "what it would see on this trajectory": {
        "value": example_imagining((FRONT_WIDE, FRONT_TELE)) | example_trajectory()
    },
}


def imagine_router(deps: Dependencies) -> APIRouter:
    """The endpoint; pictures take places as draws of /v1/plan do."""
    router = APIRouter(route_class=payload_route(lambda _: deps.planning.check_open()), tags=["planning"])
    refusals = problems(*REFUSALS, CANNOT_IMAGINE, INVALID_TRAJECTORY)

    @router.post(
        "/v1/imagine",
        response_model=wire_imagine.ImagineResponse,
        responses=refusals | answers_and_stream(*wire_imagine.EVENTS),
        openapi_extra=payloads(wire_imagine.ImagineRequest),
    )
    async def imagine(
        request: Request, asked: Annotated[wire_imagine.ImagineRequest, Body(openapi_examples=EXAMPLES)]
    ) -> Any:
        """What a camera will see in half a second: n pictures, and what the model perceives and predicts."""
        arrival = arrival_of(request)
        imagining = imagining_of(asked, deps.lifecycle.card)
        events = deps.planning.events(imagining.planning, arrival)

        async def answer(planned: PlannedScene) -> wire_imagine.ImagineResponse:
            # On a thread: painting must not hold up the answers of others.
            return await asyncio.to_thread(imagine_answer, imagining, planned, arrival)

        async def work() -> wire_imagine.ImagineResponse:
            return await answer(await last(events))

        if asked.stream:
            return await streamed(
                request,
                events,
                lambda: ImagineTeller(imagining.imagination),
                lambda told: server_sent(told, answer, arrival.request_id),
                deps.metrics,
            )
        return respond(request, await while_connected(request, work()))

    return router
