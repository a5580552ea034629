from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from looktwice.model.driving.scene_store import write_scenes
from looktwice.service.operations.settings import Settings
from tests.service.scenes import labelled
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, serve


@pytest.fixture(scope="session")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenes") / "scenes.parquet"
    write_scenes(path, [labelled("slow-leader"), labelled("second/scene", seed=600_002)])
    return path


@pytest.fixture
def settings(scene_file: Path) -> Settings:
    return Settings(bundled_scenes=scene_file)


@pytest.fixture
def engine() -> ScriptedEngine:
    return ScriptedEngine()


@pytest.fixture
def served(engine: ScriptedEngine, settings: Settings) -> Iterator[Served]:
    with serve(engine, settings) as running:
        yield running
