"""POST /v1/feedback; it needs no model."""

from __future__ import annotations

from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, Request
from fastapi.openapi.models import Example

import looktwice.clients.wire_feedback as wire_feedback
from looktwice.clients.labelling.teachers.feedback_teacher import FeedbackTeacher
from looktwice.service.admission.places import Admission, let_in
from looktwice.service.http.callers import while_connected
from looktwice.service.http.openapi import PACKED, payloads, problems
from looktwice.service.http.payloads import payload_route, respond
from looktwice.service.problems import (
    FEEDBACK_REFUSED,
    INVALID_FEEDBACK,
    OTHER_PLAN,
    TEACHER_AWAY,
    TEACHER_REFUSED,
)
from looktwice.service.routes.arrivals import arrival_of
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.routes.request_examples import example_feedback
from looktwice.service.routes.score import SCORING_REFUSALS
from looktwice.service.teaching.teacher_feedback import taught

EXAMPLES: Final[dict[str, Example]] = {"why one of two trajectories is wrong": {"value": example_feedback()}}


def feedback_router(deps: Dependencies, admission: Admission) -> APIRouter:
    """The endpoint; it takes its places from the scorer's ``admission``."""

    async def given(asked: wire_feedback.FeedbackRequest, request_id: str) -> wire_feedback.FeedbackResponse:
        found = await deps.scorer.feedback(asked, request_id)
        response = found.response
        if asked.mode == "teacher" and isinstance(deps.teacher, FeedbackTeacher):
            response = await taught(found, deps.teacher, deps.metrics)
        for each in response.feedback:
            deps.metrics.count_feedback(each.written_by, correct=each.correct)
        return response

    router = APIRouter(route_class=payload_route(lambda _: deps.check_open(admission)), tags=["scoring"])

    @router.post(
        "/v1/feedback",
        response_model=wire_feedback.FeedbackResponse,
        responses=problems(
            *SCORING_REFUSALS,
            *(INVALID_FEEDBACK, OTHER_PLAN, FEEDBACK_REFUSED, TEACHER_REFUSED, TEACHER_AWAY),
        )
        | PACKED,
        openapi_extra=payloads(wire_feedback.FeedbackRequest),
    )
    async def feedback(
        request: Request, asked: Annotated[wire_feedback.FeedbackRequest, Body(openapi_examples=EXAMPLES)]
    ) -> Any:
        """Why trajectories fail: facts, and a teacher's five sections on each that is wrong."""
        arrival = arrival_of(request)
        with deps.lifecycle.accepted(), let_in(admission.place(1)):
            await deps.planning.spend(arrival.owner, len(asked.trajectories))
            return respond(request, await while_connected(request, given(asked, arrival.request_id)))

    return router
