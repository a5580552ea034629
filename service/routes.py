"""The endpoints."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import prometheus_client
from fastapi import APIRouter, Body, Request
from fastapi.openapi.models import Example
from starlette.responses import Response

import clients.wire as wire
from clients.labelling.teachers.teacher import Teacher
from model.driving.scene import FRONT_TELE, FRONT_WIDE
from model.engines.engine import Engine
from service.examples import example_reflection, example_request
from service.labelling import label, teacher_name
from service.lifecycle import Lifecycle
from service.metrics import Metrics
from service.openapi import Responses, problems
from service.planning import CallerLeft, answer, model_card, reflect
from service.problems import (
    BODY_TOO_LARGE,
    ENGINE_FAILED,
    INVALID_CLIP,
    INVALID_CONTROLS,
    INVALID_HISTORY,
    INVALID_IMAGE,
    INVALID_JSON,
    INVALID_PLAN,
    INVALID_REQUEST,
    INVALID_ROUTE,
    INVALID_SCENE_FILE,
    LABEL_REFUSED,
    MISSING_CAMERA,
    NEEDS_ANNOTATIONS,
    NOT_READY,
    REFUSED,
    SCENES_UNREADABLE,
    TEACHER_AWAY,
    UNKNOWN_CAMERA,
    UNKNOWN_FIELD,
    UNKNOWN_FORMAT,
    UNKNOWN_SCENE,
    UNSUPPORTED_MEDIA_TYPE,
    ProblemError,
)
from service.settings import Settings
from service.views import BundledScenes, scenes_of_file, view

CALLER_LEFT_STATUS = 499
"""Nobody reads it; logs and metrics show it."""
METRICS_TEXT: Responses = {200: {"description": "Prometheus text", "content": {"text/plain": {}}}}
EXAMPLES: dict[str, Example] = {"straight on": {"value": example_request((FRONT_WIDE, FRONT_TELE))}}


REFLECT_EXAMPLES: dict[str, Example] = {
    "is it right to go on?": {"value": example_reflection((FRONT_WIDE, FRONT_TELE))}
}

_Asked = TypeVar("_Asked")
_Work = Callable[[_Asked, Engine, Metrics, str, Callable[[], Awaitable[None]]], Awaitable[Any]]


@dataclass(frozen=True)
class Parts:
    """What the endpoints work with."""

    engine: Engine
    settings: Settings
    metrics: Metrics
    lifecycle: Lifecycle
    teacher: Teacher


def make_router(parts: Parts) -> APIRouter:
    """All endpoints but the inspector page."""
    router = APIRouter()
    _add_planning(router, parts)
    _add_probes(router, parts)
    _add_scenes(router, parts)
    return router


def _add_planning(router: APIRouter, parts: Parts) -> None:
    refusals = problems(
        *(INVALID_JSON, BODY_TOO_LARGE, UNSUPPORTED_MEDIA_TYPE, INVALID_REQUEST, UNKNOWN_FIELD),
        *(INVALID_CLIP, UNKNOWN_CAMERA, MISSING_CAMERA, INVALID_IMAGE, INVALID_HISTORY, INVALID_ROUTE),
        *(INVALID_CONTROLS, INVALID_PLAN, UNKNOWN_FORMAT, REFUSED, NOT_READY, ENGINE_FAILED),
    )

    @router.post("/v1/plan", tags=["planning"], response_model=wire.PlanResponse, responses=refusals)
    async def plan(request: Request, asked: wire.PlanRequest = Body(openapi_examples=EXAMPLES)) -> Any:
        """One scene: per draw a plan, the branch, a second look where one was taken, a trajectory."""
        return await _while_connected(request, parts, asked, answer)

    @router.post("/v1/reflect", tags=["planning"], response_model=wire.ReflectResponse, responses=refusals)
    async def look_at(
        request: Request, asked: wire.ReflectRequest = Body(openapi_examples=REFLECT_EXAMPLES)
    ) -> Any:
        """A second look at a given plan: keep it or revise it, why, and the trajectory that follows."""
        return await _while_connected(request, parts, asked, reflect)

    @router.post(
        "/v1/label",
        tags=["labelling"],
        responses=problems(
            *(INVALID_JSON, BODY_TOO_LARGE, UNSUPPORTED_MEDIA_TYPE, INVALID_REQUEST, UNKNOWN_FIELD),
            *(INVALID_CLIP, UNKNOWN_CAMERA, INVALID_IMAGE, INVALID_HISTORY, INVALID_ROUTE, INVALID_PLAN),
            *(NEEDS_ANNOTATIONS, LABEL_REFUSED, TEACHER_AWAY),
        ),
    )
    async def write_label(request: Request, asked: wire.LabelRequest) -> wire.LabelResponse:
        """Why a plan is less good than another: a teacher's paragraph, checked, to train on."""
        return await label(asked, parts.teacher, parts.metrics, request.state.request_id)

    @router.get("/v1/models", tags=["planning"], responses=problems(NOT_READY, ENGINE_FAILED))
    async def models() -> wire.ModelList:
        """The models that answer here."""
        parts.lifecycle.check_ready()
        return wire.ModelList(models=[model_card(parts.engine.card)], teacher=teacher_name(parts.teacher))


async def _while_connected(request: Request, parts: Parts, asked: _Asked, work: _Work[_Asked]) -> Any:
    """What ``work`` makes of a request, or nothing once its caller has left."""
    parts.lifecycle.check_ready()

    async def caller_leaves() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    try:
        return await work(asked, parts.engine, parts.metrics, request.state.request_id, caller_leaves)
    except CallerLeft:
        return Response(status_code=CALLER_LEFT_STATUS)


def _add_probes(router: APIRouter, parts: Parts) -> None:
    @router.get("/healthz", tags=["operations"], responses=problems(ENGINE_FAILED))
    async def healthz() -> dict[str, str]:
        """Whether the process is worth keeping."""
        parts.lifecycle.check_alive()
        return {"status": "alive"}

    @router.get("/readyz", tags=["operations"], responses=problems(NOT_READY, ENGINE_FAILED))
    async def readyz() -> dict[str, str]:
        """Whether requests can be served now."""
        parts.lifecycle.check_ready()
        return {"status": "ready"}

    @router.get(
        "/metrics",
        tags=["operations"],
        response_class=Response,
        responses=problems() | METRICS_TEXT,
    )
    async def metrics() -> Response:
        """What Prometheus scrapes."""
        content = prometheus_client.generate_latest(parts.metrics.registry)
        return Response(content, media_type=prometheus_client.CONTENT_TYPE_LATEST)


def _add_scenes(router: APIRouter, parts: Parts) -> None:
    bundled = BundledScenes(parts.settings.bundled_scenes)

    @router.get("/v1/scenes", tags=["scenes"], responses=problems(SCENES_UNREADABLE))
    async def scenes() -> wire.SceneList:
        """The bundled scenes."""
        found = await asyncio.to_thread(bundled.all)
        entries = [wire.SceneEntry(scene_id=one.scene.scene_id, tags=sorted(one.tags)) for one in found]
        return wire.SceneList(scenes=entries)

    @router.get(
        "/v1/scenes/{scene_id:path}", tags=["scenes"], responses=problems(UNKNOWN_SCENE, SCENES_UNREADABLE)
    )
    async def scene(scene_id: str) -> wire.LabelledScene:
        """One bundled scene with its annotations; its `scene` can be sent to /v1/plan as it is."""
        return await asyncio.to_thread(lambda: view(bundled.one(scene_id)))

    @router.post(
        "/v1/scenes:read",
        tags=["scenes"],
        responses=problems(BODY_TOO_LARGE, INVALID_SCENE_FILE),
        openapi_extra={
            "requestBody": {
                "required": True,
                "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
            }
        },
    )
    async def read(request: Request) -> wire.SceneFile:
        """The scenes of a Parquet scene file, for looking at; nothing is kept."""
        content = await request.body()
        largest = parts.settings.max_scene_file_bytes
        if len(content) > largest:
            raise ProblemError(
                BODY_TOO_LARGE, f"the file has {len(content)} bytes; at most {largest} are read"
            )
        return wire.SceneFile(scenes=await asyncio.to_thread(scenes_of_file, content))
