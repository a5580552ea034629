"""An engine that plans nothing, for a service that only scores."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.engines.engine import EngineError, EngineLoad, Event, PlanRequest, RequestError
from looktwice.model.network.model_card import ModelCard

CARD: Final = ModelCard(
    name="no-model",
    revision="",
    engine="none",
    formats=(),
    cameras=(),
    image_size=(0, 0),
    parameters=0,
    inputs=(),
)


class NoModel:
    """`looktwice.model.engines.engine.Engine` without a model: it is always ready, and refuses every
    scene."""

    def __init__(self) -> None:
        self._stopped = asyncio.Event()

    @property
    def card(self) -> ModelCard:
        """Writes no format, so that requests are refused before they get here."""
        return CARD

    @property
    def load(self) -> EngineLoad:
        """Nothing."""
        return EngineLoad(0, 0)

    async def start(self) -> None:
        """There is nothing to load."""
        self._stopped.clear()

    async def wait(self) -> None:
        """Until it is stopped."""
        await self._stopped.wait()

    async def stop(self) -> None:
        """There is nothing to free."""
        self._stopped.set()

    async def load_weights(self, checkpoint: Path) -> None:
        """There is nothing that takes them."""
        raise EngineError("this service runs without a model")

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        """Refuse ``request``."""
        raise RequestError("this service runs without a model")
        yield

    def prompt_tokens(self, request: PlanRequest) -> int:
        """Nothing is read."""
        raise RequestError("this service runs without a model")

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> npt.NDArray[np.uint8]:
        """Nothing is imagined."""
        raise RequestError("this service runs without a model")

    def cancel(self, request_id: str) -> None:
        """Nothing runs."""
