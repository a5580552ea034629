"""GET /v1/models, and POST /v1/models:load."""

from __future__ import annotations

from fastapi import APIRouter, Request

import looktwice.clients.wire as wire
from looktwice.service.http.auth import NOBODY
from looktwice.service.http.openapi import problems
from looktwice.service.http.payloads import payload_route
from looktwice.service.planning.wire_answers import model_card
from looktwice.service.problems import (
    BODY_TIMEOUT,
    BODY_TOO_LARGE,
    CHECKPOINT_FAILED,
    FORBIDDEN,
    INVALID_JSON,
    INVALID_REQUEST,
    NOT_NOW,
    SWAP_UNDER_WAY,
    UNAUTHORIZED,
    UNKNOWN_CHECKPOINT,
    UNKNOWN_FIELD,
    UNSUPPORTED_MEDIA_TYPE,
    ProblemError,
)
from looktwice.service.routes.arrivals import arrival_of
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.teaching.labels import teacher_name


def models_router(deps: Dependencies) -> APIRouter:
    """The endpoints for the model that answers, and for replacing it."""
    router = APIRouter()

    @router.get("/v1/models", tags=["planning"], responses=problems(UNAUTHORIZED, *NOT_NOW, dialect=True))
    async def models() -> wire.ModelList:
        """The models that answer here."""
        deps.lifecycle.check_ready()
        card = model_card(deps.lifecycle.card)
        named = wire.NamedModel(id=card.name, created=deps.began_s)
        return wire.ModelList(models=[card], teacher=teacher_name(deps.teacher), data=[named])

    loading = APIRouter(route_class=payload_route(lambda _: None))

    @loading.post(
        "/v1/models:load",
        tags=["operations"],
        responses=problems(
            *(INVALID_JSON, UNAUTHORIZED, FORBIDDEN, UNKNOWN_CHECKPOINT, BODY_TIMEOUT, SWAP_UNDER_WAY),
            *(BODY_TOO_LARGE, UNSUPPORTED_MEDIA_TYPE, INVALID_REQUEST, UNKNOWN_FIELD),
            *(CHECKPOINT_FAILED, *NOT_NOW),
        ),
    )
    async def load(request: Request, asked: wire.LoadRequest) -> wire.ModelCard:
        """Let another checkpoint answer; requests that run are finished by the one that has them."""
        owner, settings = arrival_of(request).owner, deps.settings
        if owner != NOBODY and owner not in settings.operators:
            raise ProblemError(FORBIDDEN, "only operators' keys may replace the checkpoint")
        make, folder = deps.load, settings.checkpoints
        if make is None or folder is None:
            raise ProblemError(UNKNOWN_CHECKPOINT, "set LOOKTWICE_CHECKPOINTS to the folder that holds them")
        found = folder / asked.checkpoint
        if not found.is_dir():
            raise ProblemError(UNKNOWN_CHECKPOINT, f"there is no checkpoint {asked.checkpoint!r}")
        return model_card(await deps.lifecycle.replace(lambda: make(found), f"{folder}/"))

    router.include_router(loading)
    return router
