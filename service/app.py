"""The service as an ASGI application."""

from __future__ import annotations

import os
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import FastAPI
from fastapi_offline import FastAPIOffline
from prometheus_client import CollectorRegistry
from starlette.middleware.cors import CORSMiddleware

from looktwice.clients.labelling.teachers.rules import RuleTeacher
from looktwice.clients.labelling.teachers.teacher import Teacher
from looktwice.clients.wire import IDEMPOTENCY_KEY_HEADER, REQUEST_ID_HEADER
from looktwice.model.engines.engine import Engine
from looktwice.service.admission.places import Admission
from looktwice.service.admission.rates import Rates
from looktwice.service.http.auth import Guard
from looktwice.service.http.body_limit import BodyLimit
from looktwice.service.http.idempotency import Idempotency
from looktwice.service.http.middleware import Around
from looktwice.service.http.openapi import describe
from looktwice.service.http.problem_documents import install_error_handlers
from looktwice.service.inspector.page import add_inspector
from looktwice.service.operations.lifecycle import Lifecycle
from looktwice.service.operations.logs import configure_logging
from looktwice.service.operations.pulse import Pulse
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.operations.settings import Settings
from looktwice.service.operations.traces import Traces, traces_from_environment
from looktwice.service.planning.submitting import SceneSubmitter, TimeLimits
from looktwice.service.routes.dependencies import Dependencies
from looktwice.service.routes.router import make_router
from looktwice.service.scoring.process import Scorer

DESCRIPTION = """Planning for driving models that look twice before they act.

Ego frame: x forward, y left, z up, metres; heading in radians, counter-clockwise positive. Every error is a
problem document (RFC 9457) with a stable `type`; every answer carries `X-Request-ID`."""


def create_app(
    engine: Engine,
    settings: Settings,
    registry: CollectorRegistry | None = None,
    teacher: Teacher = RuleTeacher(),
    load: Callable[[Path], Engine] | None = None,
    traces: Traces | None = None,
) -> FastAPI:
    """The service over ``engine``, which it starts and stops.

    Args:
        engine: not yet started.
        settings: see `Settings`.
        registry: where metrics are registered; a new one by default, so that apps do not share counts.
        teacher: writes the reflections of /v1/label.
        load: makes an engine like this one over another checkpoint; None where none may replace it.
        traces: where spans go to; by default where the environment says.

    Raises:
        ValueError: settings that cannot be.
    """
    configure_logging(settings.log_format)
    keys = settings.keys()
    traces = traces or traces_from_environment(os.environ)
    metrics = Metrics(registry or CollectorRegistry())
    lifecycle = Lifecycle(engine, metrics)
    admission = Admission(settings.max_draws, settings.max_scenes, time.monotonic)
    metrics.watch(lambda: lifecycle.load, admission)
    limits = TimeLimits(settings.queue_timeout_s, settings.decode_timeout_s)
    planning = SceneSubmitter(lifecycle, admission, Rates(settings.rate_limit), metrics, traces, limits)
    pulse, scorer = Pulse(), Scorer(settings.bundled_scenes)
    idempotency = Idempotency(settings.idempotency_s, time.monotonic)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        lifecycle.begin()
        pulse.begin()
        try:
            yield
        finally:
            pulse.end()
            await lifecycle.end()
            await scorer.close()
            await teacher.close()

    app = FastAPIOffline(
        title="LookTwice",
        version="1",
        description=DESCRIPTION,
        lifespan=lifespan,
        # FastAPI's own page loads scripts from elsewhere; nothing here needs a network.
        docs_url="/docs",
        redoc_url=None,
        static_url="/docs/static",
        favicon_url="data:,",
    )
    # The last one added is the outermost.
    app.add_middleware(
        BodyLimit,
        max_bytes=settings.max_body_bytes,
        max_held_bytes=settings.max_held_bytes,
        large_bytes_per_s=settings.large_bytes_per_s,
        timeout_s=settings.body_timeout_s,
    )
    app.add_middleware(Guard, keys=keys, metrics=metrics, hosts=settings.answers_to())
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["GET", "POST"],
            allow_headers=["Authorization", "Content-Type", IDEMPOTENCY_KEY_HEADER, REQUEST_ID_HEADER],
            expose_headers=[REQUEST_ID_HEADER, "Retry-After"],
        )
    app.add_middleware(Around, metrics=metrics, traces=traces, stopping=lambda: lifecycle.stopping)
    install_error_handlers(app, metrics)
    began_s = int(time.time())
    deps = Dependencies(
        settings, metrics, lifecycle, planning, idempotency, teacher, load, began_s, pulse, scorer
    )
    app.include_router(make_router(deps))
    add_inspector(app)
    describe(app, keys=bool(keys))
    app.state.drain = lifecycle.drain
    return app
