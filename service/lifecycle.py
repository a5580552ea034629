"""The engine's life within the service: started in the background, watched, stopped."""

from __future__ import annotations

import asyncio

import structlog

from model.engines.engine import Engine
from service.metrics import Metrics
from service.problems import ENGINE_FAILED, NOT_READY, ProblemError

log = structlog.stdlib.get_logger()


class Lifecycle:
    """Starts the engine without holding up the server, so that probes are answered meanwhile."""

    def __init__(self, engine: Engine, metrics: Metrics) -> None:
        self._engine = engine
        self._metrics = metrics
        self._starting: asyncio.Task[None] | None = None
        self._ready = False

    @property
    def failure(self) -> str | None:
        """Why the engine could not start; None while it is starting or runs."""
        task = self._starting
        if task is None or not task.done() or task.cancelled() or task.exception() is None:
            return None
        return str(task.exception())

    def begin(self) -> None:
        """Start the engine in the background."""
        self._starting = asyncio.create_task(self._start(), name="engine start")

    async def end(self) -> None:
        """Stop the engine, also one that is still starting."""
        self._ready = False
        self._metrics.ready.set(0)
        if self._starting is not None:
            self._starting.cancel()
            await asyncio.gather(self._starting, return_exceptions=True)
        await self._engine.stop()

    def check_ready(self) -> None:
        """Raise `ProblemError` unless the engine can plan."""
        if self.failure is not None:
            raise ProblemError(ENGINE_FAILED, f"the engine did not start: {self.failure}")
        if not self._ready:
            raise ProblemError(NOT_READY, "the model is loading and warming up")

    def check_alive(self) -> None:
        """Raise `ProblemError` when only a restart can help."""
        if self.failure is not None:
            raise ProblemError(ENGINE_FAILED, f"the engine did not start: {self.failure}")

    async def _start(self) -> None:
        try:
            await self._engine.start()
        except Exception:
            log.exception("engine did not start")
            raise
        card = self._engine.card
        self._metrics.model_loaded(card)
        self._metrics.ready.set(1)
        self._ready = True
        log.info("ready", model=card.name, revision=card.revision, engine=card.engine)
