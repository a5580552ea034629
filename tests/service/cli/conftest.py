"""Scenes of the simulator with their manifest, made once for the whole session."""

from __future__ import annotations

from pathlib import Path

import pytest

from looktwice.clients.metadrive import simulator
from looktwice.clients.metadrive.generation.blocks import GenerateConfig, write_block, write_manifest


@pytest.fixture(scope="session")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scenes of three short episodes."""
    if not simulator.is_installed():
        pytest.skip("MetaDrive is not installed (make sim)")
    folder = tmp_path_factory.mktemp("scenes")
    config = GenerateConfig(stride_s=1.0, duration_s=12.0, dense=False, lapses=True)
    write_block(folder, range(2, 5), config)
    write_manifest(folder, config)
    return folder
