"""The service as an ASGI application."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI
from prometheus_client import CollectorRegistry

from clients.labelling.teachers.rules import RuleTeacher
from clients.labelling.teachers.teacher import Teacher
from model.engines.engine import Engine
from service.body_limit import BodyLimit
from service.errors import install_error_handlers
from service.inspector.page import add_inspector
from service.lifecycle import Lifecycle
from service.logs import configure_logging
from service.metrics import Metrics
from service.middleware import Around
from service.openapi import describe
from service.routes import Parts, make_router
from service.settings import Settings

DESCRIPTION = """Planning for driving models that look twice before they act.

Ego frame: x forward, y left, z up, metres; heading in radians, counter-clockwise positive. Every error is a
problem document (RFC 9457) with a stable `type`; every answer carries `X-Request-ID`."""


def create_app(
    engine: Engine,
    settings: Settings,
    registry: CollectorRegistry | None = None,
    teacher: Teacher = RuleTeacher(),
) -> FastAPI:
    """The service over ``engine``, which it starts and stops.

    Args:
        engine: not yet started.
        settings: see `Settings`.
        teacher: writes the reflections of /v1/label.
        registry: where metrics are registered; a new one by default, so that apps do not share counts.
    """
    configure_logging(settings.log_format)
    metrics = Metrics(registry or CollectorRegistry())
    lifecycle = Lifecycle(engine, metrics)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        lifecycle.begin()
        try:
            yield
        finally:
            await lifecycle.end()
            await teacher.close()

    app = FastAPI(
        title="LookTwice",
        version="1",
        description=DESCRIPTION,
        lifespan=lifespan,
        # Both pages load scripts from elsewhere; the inspector and /openapi.json need no network.
        docs_url=None,
        redoc_url=None,
    )
    app.add_middleware(BodyLimit, max_bytes=settings.max_body_bytes)
    app.add_middleware(Around, metrics=metrics)
    install_error_handlers(app)
    app.include_router(make_router(Parts(engine, settings, metrics, lifecycle, teacher)))
    add_inspector(app)
    describe(app)
    return app
