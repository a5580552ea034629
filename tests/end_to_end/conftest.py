"""A service over the checkpoint that a module of tests names ``CHECKPOINT``, and a client of it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from looktwice.clients.planner import PlannerClient, RetryPolicy
from looktwice.model.bundled import SCENES
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.service.operations.settings import Settings
from tests.service.serving import Served, serve


@pytest.fixture(scope="module")
def served(request: pytest.FixtureRequest) -> Iterator[Served[TorchEngine]]:
    with serve(TorchEngine(request.module.CHECKPOINT), Settings(bundled_scenes=SCENES)) as served:
        yield served


@pytest.fixture(scope="module")
def planner(served: Served[TorchEngine]) -> Iterator[PlannerClient]:
    with PlannerClient(served.url, RetryPolicy(timeout_s=120)) as planner:
        yield planner
