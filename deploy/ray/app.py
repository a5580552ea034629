"""The service as a Ray Serve application: every replica is a whole service with an engine of its own.

Replicas, back-pressure and autoscaling are declared in ``serve.yaml``; see docs/deployment.md.
"""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any, Final, Literal

import httpx
from fastapi import FastAPI
from prometheus_client import CollectorRegistry, start_http_server
from pydantic import BaseModel, ConfigDict, Field
from ray import serve
from ray.serve import Application

from looktwice.model.bundled import CHECKPOINT
from looktwice.service.app import create_app
from looktwice.service.cli.engines import make_engine
from looktwice.service.http.server import check_who_may_ask
from looktwice.service.operations.settings import Settings, TeacherSettings

_GLANCE_S: Final = 0.2


class Arguments(BaseModel):
    """What ``args`` in a Serve configuration may say; unknown keys are refused.

    Attributes:
        checkpoint: folder that every node can read.
        engine, device, rows, vllm_arguments: as `looktwice serve` takes them.
        metrics_port: where a replica shows its own metrics on its node, so only with one replica a node;
            /metrics behind Serve's proxy shows those of whichever replica answers. No key is asked for there,
            whatever the settings say: let only Prometheus reach it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    checkpoint: Path = CHECKPOINT
    engine: Literal["torch", "vllm"] = "torch"
    device: Literal["cpu", "cuda"] = "cpu"
    rows: int = Field(default=64, ge=1)
    vllm_arguments: dict[str, Any] = {}
    metrics_port: int | None = Field(default=None, ge=1, le=65535)


class Planning:
    """One replica; its options are the configuration's.

    Raises:
        ValueError: everybody could ask. Serve's proxies hand on what they are sent, so a replica counts as
            reachable from elsewhere wherever they listen.
    """

    def __init__(self, arguments: Arguments) -> None:
        settings = Settings()
        check_who_may_ask(settings, "Ray Serve's proxies")
        engine = make_engine(
            arguments.checkpoint,
            arguments.rows,
            name=arguments.engine,
            device=arguments.device,
            vllm_arguments=json.dumps(arguments.vllm_arguments),
        )
        registry = CollectorRegistry()
        self._app = create_app(engine, settings, registry, TeacherSettings().teacher())
        self._ready = False
        if arguments.metrics_port is not None:
            start_http_server(arguments.metrics_port, registry=registry)

    def __serve_build_asgi_app__(self) -> FastAPI:
        """Called by Serve, which then starts the application and with it the engine."""
        return self._app

    async def check_health(self) -> None:
        """Called by Serve: it routes to a replica after the first answer, and replaces one that raises."""
        await self._check_alive()
        while not self._ready:
            await asyncio.sleep(_GLANCE_S)
            await self._check_alive()
            self._ready = await self._answers("/readyz")

    async def _check_alive(self) -> None:
        if not await self._answers("/healthz"):
            raise RuntimeError("the engine has failed; only another replica helps")

    async def _answers(self, path: str) -> bool:
        transport = httpx.ASGITransport(self._app)
        async with httpx.AsyncClient(transport=transport, base_url="http://replica") as client:
            return (await client.get(path)).is_success


def application(arguments: dict[str, Any]) -> Application:
    """What ``import_path`` names; Serve hands it what the configuration has in ``args``.

    Raises:
        ValidationError: they are no `Arguments`.
    """
    deployment = serve.deployment()(serve.ingress()(Planning))
    return deployment.bind(Arguments.model_validate(arguments))
