from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def untrained_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint folder with random weights; shared, so do not write into it."""
    from tests.checkpoints import write_untrained

    return write_untrained(tmp_path_factory.mktemp("checkpoint") / "untrained")
