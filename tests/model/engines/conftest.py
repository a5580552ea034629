from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from model.network.checkpoint import Loaded, load
from tests.model.engines.reference import exactly


@pytest.fixture(scope="module")
def exact(untrained_checkpoint: Path) -> Loaded:
    """In float64, so that rounding cannot flip a draw."""
    return exactly(load(untrained_checkpoint, dtype=torch.float64))


@pytest.fixture
def inference() -> Iterator[None]:
    """What a decoder is called under."""
    with torch.inference_mode():
        yield
