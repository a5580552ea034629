"""GET /v1/scenes, and POST /v1/scenes:read."""

from __future__ import annotations

import asyncio
from typing import Any, Final

from fastapi import APIRouter, Request
from starlette.responses import Response

import looktwice.clients.wire as wire
from looktwice.service.http.callers import while_connected
from looktwice.service.http.openapi import problems
from looktwice.service.problems import (
    BODY_TIMEOUT,
    BODY_TOO_LARGE,
    INVALID_SCENE_FILE,
    SCENES_UNREADABLE,
    UNAUTHORIZED,
    UNKNOWN_SCENE,
    ProblemError,
)
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.scenes.bundled import BundledScenes, view
from looktwice.service.scenes.files import read_scene_file

_FILES_AT_ONCE: Final = 1
"""Scene files that are unpacked, which may take much memory; others wait."""


def scenes_router(deps: Dependencies) -> APIRouter:
    """The endpoints for scenes to look at."""
    router = APIRouter()
    bundled = BundledScenes(deps.settings.bundled_scenes)
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

    return router
