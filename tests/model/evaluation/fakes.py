"""Draws and an engine without a network, for tests of the evaluation."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.plan import Plan
from looktwice.model.driving.trajectory import FloatArray, constant_velocity
from looktwice.model.engines.engine import (
    Draw,
    DrawFinished,
    EngineError,
    EngineLoad,
    Event,
    PlanRequest,
    RequestError,
    SectionFinished,
)
from looktwice.model.network.card import CheckpointError
from looktwice.model.network.model_card import ModelCard


def draw_of(
    trajectory: FloatArray,
    plan: Plan | None = None,
    revised: Plan | None = None,
    index: int = 0,
    tokens: int = 20,
) -> Draw:
    """A draw; it has reflected when it has a revised plan."""
    branch = None if plan is None else ("Action:" if revised is None else "Thinking:")
    return Draw(
        index=index,
        text="",
        plan=plan,
        branch=branch,
        think_probability=None if branch is None else 0.25,
        thinking=None if revised is None else "The vehicle ahead brakes.",
        revised_plan=revised,
        trajectory=trajectory,
        codes=(1, 2, 3, 4, 5, 6),
        tokens={"plan": tokens - 8, "trajectory": 8},
    )


class FakeEngine:
    """Draws constant-velocity trajectories, each a metre farther to the left; answers out of order.

    It notes requests and how many were under way at once, and fails for scenes named in ``broken``. The
    first answer comes when ``company`` requests are under way.
    """

    def __init__(self, broken: frozenset[str] = frozenset(), missing: int = 0, company: int = 1) -> None:
        self.requests: list[PlanRequest] = []
        self.under_way = 0
        self.most_under_way = 0
        self._broken = broken
        self._missing = missing
        self._company = company

    @property
    def load(self) -> EngineLoad:
        return EngineLoad(rows=64, rows_used=0)

    async def wait(self) -> None:
        await asyncio.Event().wait()

    @property
    def card(self) -> ModelCard:
        return ModelCard("fake", "1", "torch", ("cf_vla",), (), (1, 1), 0)

    async def start(self) -> None:
        return None

    async def stop(self) -> None:
        return None

    async def load_weights(self, checkpoint: Path) -> None:
        raise CheckpointError("a fake has no weights")

    def cancel(self, request_id: str) -> None:
        return None

    def prompt_tokens(self, request: PlanRequest) -> int:
        raise RequestError("a fake reads nothing")

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> npt.NDArray[np.uint8]:
        raise RequestError("a fake paints nothing")

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        self.requests.append(request)
        self.under_way += 1
        self.most_under_way = max(self.most_under_way, self.under_way)
        try:
            async with asyncio.timeout(30):
                while self.most_under_way < self._company:
                    await asyncio.sleep(0.001)
            await asyncio.sleep(0.002 if len(self.requests) % 2 else 0)
            if request.scene.scene_id in self._broken:
                raise EngineError("out of memory")
            for index in reversed(range(request.controls.n - self._missing)):
                trajectory = constant_velocity(request.scene.history)
                trajectory[:, 1] += index
                yield SectionFinished(index, "plan", "")
                yield DrawFinished(draw_of(trajectory, request.controls.prefill, index=index))
        finally:
            self.under_way -= 1


def offset(trajectory: FloatArray, metres: float) -> FloatArray:
    """A trajectory moved to the left."""
    return (trajectory + np.array([0, metres, 0, 0], np.float32)).astype(np.float32)
