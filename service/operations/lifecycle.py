"""The engine's life within the service: started, watched, restarted, replaced, drained, stopped."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Final

import structlog

from looktwice.model.engines.engine import Engine, EngineLoad
from looktwice.model.network.model_card import ModelCard
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.problems import (
    CHECKPOINT_FAILED,
    DRAINING,
    ENGINE_FAILED,
    NOT_READY,
    SWAP_UNDER_WAY,
    ProblemError,
)

_FIRST_WAIT_S: Final = 0.5
_LONGEST_WAIT_S: Final = 30.0
_HOPELESS: Final = 3
"""Starts in a row that fail before the process says that only a restart of it can help."""

log = structlog.stdlib.get_logger()


class Lifecycle:
    """Keeps an engine running without holding up the server, so that probes are answered meanwhile.

    Args:
        engine: not yet started.
        metrics: where it shows what it does.
    """

    def __init__(self, engine: Engine, metrics: Metrics) -> None:
        self._engine, self._metrics = engine, metrics
        self._keeping: asyncio.Task[None] | None = None
        self._retiring: set[asyncio.Task[None]] = set()
        self._users: dict[int, int] = {}
        self._accepted = 0
        self._nobody = asyncio.Event()
        self._nobody.set()
        self._ready = self._draining = self._swapping = False
        self._failures, self._broke = 0, False

    @property
    def card(self) -> ModelCard:
        """Of the engine that answers."""
        return self._engine.card

    @property
    def load(self) -> EngineLoad:
        """Of the engine that answers."""
        return self._engine.load

    def begin(self) -> None:
        """Start the engine in the background."""
        self._keeping = asyncio.create_task(self._keep(self._engine), name="engine")

    async def end(self) -> None:
        """Stop every engine, also one that is still starting."""
        self._set_ready(False)
        tasks = {task for task in (self._keeping, *self._retiring) if task is not None}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._engine.stop()

    @property
    def stopping(self) -> bool:
        """Whether the service is about to stop."""
        return self._draining

    @contextmanager
    def accepted(self) -> Generator[None]:
        """A request that is to be answered whatever comes: a drain waits until the block ends.

        Raises:
            ProblemError: the service is about to stop.
        """
        self.check_accepting()
        self._accepted += 1
        self._nobody.clear()
        try:
            yield
        finally:
            self._accepted -= 1
            if not self._accepted:
                self._nobody.set()

    @contextmanager
    def engine(self) -> Generator[Engine]:
        """The engine that answers now, kept until the block ends even when it is replaced.

        For requests that were accepted, so also while the service drains.

        Raises:
            ProblemError: no engine can answer.
        """
        self._check_engine()
        engine = self._engine
        self._users[id(engine)] = self._users.get(id(engine), 0) + 1
        try:
            yield engine
        finally:
            self._users[id(engine)] -= 1
            if not self._users[id(engine)]:
                del self._users[id(engine)]

    def check_accepting(self) -> None:
        """Raise `ProblemError` once the service is about to stop."""
        if self._draining:
            raise ProblemError(DRAINING, "ask another replica; this one finishes what it has accepted")

    def check_ready(self) -> None:
        """Raise `ProblemError` unless the engine can plan for new requests."""
        self.check_accepting()
        self._check_engine()

    def _check_engine(self) -> None:
        if self._ready:
            return
        if self._broke:
            raise ProblemError(ENGINE_FAILED, "the engine broke and is being started again; the log has why")
        raise ProblemError(NOT_READY, "the model is loading and warming up")

    def check_alive(self) -> None:
        """Raise `ProblemError` when only a restart of the process can help."""
        if self._failures >= _HOPELESS:
            raise ProblemError(
                ENGINE_FAILED, f"the engine did not start {self._failures} times in a row; the log has why"
            )

    async def drain(self) -> None:
        """Accept nothing more; returns when everything that was accepted is finished."""
        self._draining = True
        self._metrics.draining.set(1)
        self._metrics.ready.set(0)
        log.info("draining", requests=self._accepted)
        await self._nobody.wait()

    @contextmanager
    def _swap(self) -> Generator[None]:
        if self._swapping:
            raise ProblemError(SWAP_UNDER_WAY, "wait until it answers, then ask again")
        self._swapping = True
        try:
            yield
        finally:
            self._swapping = False

    async def replace(self, make: Callable[[], Engine], hidden: str = "") -> ModelCard:
        """Let another engine answer; requests that run are finished by the one that has them.

        Args:
            make: loads the engine; called on a thread.
            hidden: what callers are not told, such as where checkpoints lie.

        Raises:
            ProblemError: it cannot be loaded or started; the one that answered still does.
        """
        self.check_ready()
        with self._swap():
            engine: Engine | None = None
            try:
                engine = await asyncio.to_thread(make)
                await engine.start()
            except Exception as error:
                if engine is not None:
                    await engine.stop()
                self._metrics.checkpoint_swapped("failed")
                log.warning("checkpoint refused", reason=str(error))
                raise ProblemError(CHECKPOINT_FAILED, str(error).replace(hidden, "")) from error
            assert self._keeping is not None
            old, keeping = self._engine, self._keeping
            self._engine = engine
            self._keeping = asyncio.create_task(self._keep(engine, started=True), name="engine")
            retiring = asyncio.create_task(self._retire(old, keeping), name="old engine")
            self._retiring.add(retiring)
            retiring.add_done_callback(self._retiring.discard)
            self._metrics.checkpoint_swapped("done")
            return engine.card

    async def _retire(self, engine: Engine, keeping: asyncio.Task[None]) -> None:
        keeping.cancel()
        await asyncio.gather(keeping, return_exceptions=True)
        try:
            while self._users.get(id(engine)):
                await asyncio.sleep(0.05)
        finally:
            await engine.stop()
        log.info("old engine stopped", revision=engine.card.revision)

    async def _keep(self, engine: Engine, *, started: bool = False) -> None:
        """Start the engine, and again whenever it breaks."""
        wait_s = _FIRST_WAIT_S
        while True:
            try:
                if not started:
                    await engine.start()
                started, wait_s, self._failures = False, _FIRST_WAIT_S, 0
                self._metrics.model_loaded(engine.card)
                self._set_ready(True)
                card = engine.card
                log.info("ready", model=card.name, revision=card.revision, engine=card.engine)
                await engine.wait()
                return
            except Exception as error:  # whatever an engine dies of
                self._broke = True
                self._failures += not self._ready
                log.error("engine broke", reason=str(error), ready=self._ready, exc_info=error)
            self._set_ready(False)
            await engine.stop()
            await asyncio.sleep(wait_s)
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
            self._metrics.engine_restarted()

    def _set_ready(self, ready: bool) -> None:
        self._ready = ready
        self._metrics.ready.set(ready and not self._draining)
