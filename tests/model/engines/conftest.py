from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from looktwice.model.engines.torch.decoder import Decoder
from looktwice.model.network.checkpoint import Loaded, load
from tests.model.engines.integrity import check_integrity
from tests.model.engines.reference import exactly


@pytest.fixture(scope="module")
def exact(untrained_checkpoint: Path) -> Loaded:
    """In float64, so that rounding cannot flip a draw."""
    return exactly(load(untrained_checkpoint, dtype=torch.float64))


@pytest.fixture(scope="module")
def loop() -> Iterator[asyncio.AbstractEventLoop]:
    """One loop for all tests of a module: an engine belongs to the loop that it was started in."""
    loop = asyncio.new_event_loop()
    yield loop
    loop.close()


@pytest.fixture
def inference() -> Iterator[None]:
    """What a decoder is called under."""
    with torch.inference_mode():
        yield


@pytest.fixture(autouse=True)
def _books(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """After every test the books of all decoders that it made agree with each other."""
    made: list[Decoder] = []
    initialise = Decoder.__init__

    def noting(decoder: Decoder, *args: Any, **named: Any) -> None:
        initialise(decoder, *args, **named)
        made.append(decoder)

    monkeypatch.setattr(Decoder, "__init__", noting)
    yield
    for decoder in made:
        check_integrity(decoder)
