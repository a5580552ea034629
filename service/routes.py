"""The endpoints."""

from __future__ import annotations

import asyncio
import time
from typing import Any, Final

from fastapi import APIRouter, Request
from prometheus_client.exposition import choose_encoder
from starlette.responses import Response

import looktwice.clients.wire as wire
from looktwice.service.admission import Admission
from looktwice.service.answers import model_card
from looktwice.service.auth import NOBODY
from looktwice.service.callers import while_connected
from looktwice.service.dependencies import Dependencies
from looktwice.service.feedback_routes import feedback_router
from looktwice.service.imagine_routes import imagine_router
from looktwice.service.inspector_scenes import BundledScenes, view
from looktwice.service.labelling import label, teacher_name
from looktwice.service.openai_routes import openai_router
from looktwice.service.openapi import PACKED, Responses, payloads, problems
from looktwice.service.payloads import LARGE_BODIES, payload_route
from looktwice.service.planning import full_as_problem, let_in
from looktwice.service.planning_routes import arrival_of, planning_router, respond
from looktwice.service.problems import (
    BODY_TIMEOUT,
    BODY_TOO_LARGE,
    CHECKPOINT_FAILED,
    DRAINING,
    ENGINE_FAILED,
    FORBIDDEN,
    INVALID_BODY,
    INVALID_CLIP,
    INVALID_HISTORY,
    INVALID_IMAGE,
    INVALID_JSON,
    INVALID_PLAN,
    INVALID_REQUEST,
    INVALID_ROUTE,
    INVALID_SCENE_FILE,
    LABEL_REFUSED,
    NEEDS_ANNOTATIONS,
    NOT_READY,
    NOTHING_IN_VIEW,
    QUEUE_FULL,
    RATE_LIMITED,
    SCENES_UNREADABLE,
    SWAP_UNDER_WAY,
    TEACHER_AWAY,
    TEACHER_REFUSED,
    UNAUTHORIZED,
    UNKNOWN_CAMERA,
    UNKNOWN_CHECKPOINT,
    UNKNOWN_FIELD,
    UNKNOWN_SCENE,
    UNSUPPORTED_MEDIA_TYPE,
    ProblemError,
)
from looktwice.service.refine_routes import refine_router
from looktwice.service.scene_files import read_scene_file
from looktwice.service.scoring_routes import scoring_router

_FILES_AT_ONCE: Final = 1
"""Scene files that are unpacked, which may take much memory; others wait."""
NOT_NOW = (NOT_READY, DRAINING, ENGINE_FAILED)
METRICS_TEXT: Responses = {
    200: {
        "description": "Prometheus text",
        "content": {"text/plain": {}, "application/openmetrics-text": {}},
    }
}


def make_router(deps: Dependencies) -> APIRouter:
    """All endpoints but the inspector page."""
    router = APIRouter()
    router.include_router(planning_router(deps))
    router.include_router(refine_router(deps))
    router.include_router(imagine_router(deps))
    router.include_router(openai_router(deps))
    _add_labelling(router, deps)
    bundled = BundledScenes(deps.settings.bundled_scenes)
    scoring = Admission(deps.settings.max_scenes, deps.settings.max_scenes, time.monotonic)
    router.include_router(scoring_router(deps, scoring))
    router.include_router(feedback_router(deps, scoring))
    _add_models(router, deps)
    _add_probes(router, deps)
    _add_scenes(router, deps, bundled)
    return router


def _add_labelling(router: APIRouter, deps: Dependencies) -> None:
    # A teacher that is slow must not gather callers and their pictures without end.
    admission = Admission(deps.settings.max_scenes, deps.settings.max_scenes, time.monotonic)

    def check_open(_: Request) -> None:
        deps.lifecycle.check_accepting()
        with full_as_problem():
            admission.check_open()

    labelling = APIRouter(route_class=payload_route(check_open))

    @labelling.post(
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

    router.include_router(labelling)


def _add_models(router: APIRouter, deps: Dependencies) -> None:
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


def _add_probes(router: APIRouter, deps: Dependencies) -> None:
    @router.get("/healthz", tags=["operations"], responses=problems(ENGINE_FAILED))
    async def healthz() -> dict[str, str]:
        """Whether the process is worth keeping."""
        deps.lifecycle.check_alive()
        return {"status": "alive"}

    @router.get("/readyz", tags=["operations"], responses=problems(*NOT_NOW))
    async def readyz() -> dict[str, str]:
        """Whether requests can be served now, and were lately."""
        deps.lifecycle.check_ready()
        for stood_s, what in (
            (deps.pulse.stood_still_s, "nobody was answered for {:.1f} s"),
            (deps.pulse.threads_wait_s, "requests have waited for {:.1f} s to be checked"),
            (LARGE_BODIES.reading_s, "one large body has been read for {:.1f} s"),
            (deps.lifecycle.load.pictures_wait_s, "pictures have waited for {:.1f} s to be decoded"),
        ):
            if stood_s > deps.settings.stall_s:
                raise ProblemError(NOT_READY, what.format(stood_s))
        return {"status": "ready"}

    @router.get(
        "/metrics",
        tags=["operations"],
        response_class=Response,
        responses=problems(UNAUTHORIZED) | METRICS_TEXT,
    )
    async def metrics(request: Request) -> Response:
        """What Prometheus scrapes; in OpenMetrics' format where it is asked for."""
        encode, media_type = choose_encoder(request.headers.get("accept", ""))
        return Response(encode(deps.metrics.registry), headers={"Content-Type": media_type})


def _add_scenes(router: APIRouter, deps: Dependencies, bundled: BundledScenes) -> None:
    reading = asyncio.Semaphore(_FILES_AT_ONCE)

    @router.get("/v1/scenes", tags=["scenes"], responses=problems(UNAUTHORIZED, SCENES_UNREADABLE))
    async def scenes() -> wire.SceneList:
        """The bundled scenes."""
        found = await asyncio.to_thread(bundled.all)
        entries = [wire.SceneEntry(scene_id=one.scene.scene_id, tags=sorted(one.tags)) for one in found]
        return wire.SceneList(scenes=entries)

    @router.get(
        "/v1/scenes/{scene_id:path}",
        tags=["scenes"],
        responses=problems(UNAUTHORIZED, UNKNOWN_SCENE, SCENES_UNREADABLE),
    )
    async def scene(scene_id: str) -> wire.LabelledScene:
        """One bundled scene with its annotations; its `scene` can be sent to /v1/plan as it is."""
        return await asyncio.to_thread(lambda: view(bundled.one(scene_id)))

    @router.post(
        "/v1/scenes:read",
        tags=["scenes"],
        response_model=wire.SceneFile,
        responses=problems(UNAUTHORIZED, BODY_TIMEOUT, BODY_TOO_LARGE, INVALID_SCENE_FILE),
        openapi_extra={
            "requestBody": {
                "required": True,
                "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
            }
        },
    )
    async def read(request: Request) -> Any:
        """The scenes of a Parquet scene file, for looking at; nothing is kept."""
        content = await request.body()
        largest = deps.settings.max_scene_file_bytes
        if len(content) > largest:
            raise ProblemError(
                BODY_TOO_LARGE, f"the file has {len(content)} bytes; at most {largest} are read"
            )
        async with reading:
            told = await while_connected(request, read_scene_file(content))
        return Response(told, media_type="application/json")
