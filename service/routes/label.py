"""POST /v1/label."""

from __future__ import annotations

import time
from typing import Any

from fastapi import APIRouter, Request

import looktwice.clients.wire as wire
from looktwice.service.admission.places import Admission, let_in
from looktwice.service.http.callers import while_connected
from looktwice.service.http.openapi import PACKED, payloads, problems
from looktwice.service.http.payloads import payload_route, respond
from looktwice.service.problems import (
    BODY_TIMEOUT,
    BODY_TOO_LARGE,
    DRAINING,
    INVALID_BODY,
    INVALID_CLIP,
    INVALID_HISTORY,
    INVALID_IMAGE,
    INVALID_JSON,
    INVALID_PLAN,
    INVALID_REQUEST,
    INVALID_ROUTE,
    LABEL_REFUSED,
    NEEDS_ANNOTATIONS,
    NOTHING_IN_VIEW,
    QUEUE_FULL,
    RATE_LIMITED,
    TEACHER_AWAY,
    TEACHER_REFUSED,
    UNAUTHORIZED,
    UNKNOWN_CAMERA,
    UNKNOWN_FIELD,
    UNSUPPORTED_MEDIA_TYPE,
)
from looktwice.service.routes.arrivals import arrival_of
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.teaching.labels import label


def label_router(deps: Dependencies) -> APIRouter:
    """The endpoint; its teacher has places of its own."""
    # A teacher that is slow must not gather callers and their pictures without end.
    admission = Admission(deps.settings.max_scenes, deps.settings.max_scenes, time.monotonic)

    router = APIRouter(route_class=payload_route(lambda _: deps.check_open(admission)))

    @router.post(
        "/v1/label",
        tags=["labelling"],
        response_model=wire.LabelResponse,
        responses=problems(
            *(INVALID_JSON, INVALID_BODY, UNAUTHORIZED, BODY_TIMEOUT, BODY_TOO_LARGE),
            *(UNSUPPORTED_MEDIA_TYPE, INVALID_REQUEST, UNKNOWN_FIELD),
            *(INVALID_CLIP, UNKNOWN_CAMERA, INVALID_IMAGE, INVALID_HISTORY, INVALID_ROUTE, INVALID_PLAN),
            *(NEEDS_ANNOTATIONS, NOTHING_IN_VIEW, LABEL_REFUSED, TEACHER_REFUSED),
            *(QUEUE_FULL, RATE_LIMITED, TEACHER_AWAY),
            DRAINING,
        )
        | PACKED,
        openapi_extra=payloads(wire.LabelRequest),
    )
    async def write_label(request: Request, asked: wire.LabelRequest) -> Any:
        """Why a plan is less good than another: a teacher's paragraph, checked, to train on."""
        arrival = arrival_of(request)
        with deps.lifecycle.accepted(), let_in(admission.place(1)):
            await deps.planning.spend(arrival.owner, 1)
            written = label(asked, deps.teacher, deps.metrics, arrival.request_id)
            return respond(request, await while_connected(request, written))

    return router
