"""GET /healthz, /readyz and /metrics."""

from __future__ import annotations

from fastapi import APIRouter, Request
from prometheus_client.exposition import choose_encoder
from starlette.responses import Response

from looktwice.service.http.openapi import Responses, problems
from looktwice.service.http.payloads import LARGE_BODIES
from looktwice.service.problems import ENGINE_FAILED, NOT_NOW, NOT_READY, UNAUTHORIZED, ProblemError
from looktwice.service.routes.dependencies import Dependencies

METRICS_TEXT: Responses = {
    200: {
        "description": "Prometheus text",
        "content": {"text/plain": {}, "application/openmetrics-text": {}},
    }
}


def probes_router(deps: Dependencies) -> APIRouter:
    """The endpoints that tell how the service fares."""
    router = APIRouter()

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

    return router
