from __future__ import annotations

import os
from pathlib import Path

import pytest

# Small tensors: a second thread gains nothing, and where another process has the core it costs tenfold.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(scope="session")
def untrained_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint folder with random weights; shared, so do not write into it."""
    from tests.checkpoints import write_untrained

    return write_untrained(tmp_path_factory.mktemp("checkpoint") / "untrained")
