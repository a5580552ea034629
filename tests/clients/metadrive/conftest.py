"""One short episode, driven and photographed once for the whole session."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from looktwice.clients.metadrive import simulator

if not simulator.is_installed():
    pytest.skip("MetaDrive is not installed (make sim)", allow_module_level=True)

from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.scenes.windows import labelled_scenes
from looktwice.clients.metadrive.world.episode import run_episode
from looktwice.clients.metadrive.world.episode_log import EpisodeLog
from looktwice.model.driving.scene import LabelledScene

SEED = 2
DURATION_S = 14.0


@dataclass(frozen=True)
class Filmed:
    """An episode, its log and its scenes."""

    log: EpisodeLog
    scenes: tuple[LabelledScene, ...]


@pytest.fixture(scope="session")
def rig() -> Iterator[Any]:
    made = Rig()
    yield made
    made.close()


@pytest.fixture(scope="session")
def filmed(rig: Rig) -> Filmed:
    log = run_episode(SEED, DURATION_S)
    return Filmed(log, tuple(labelled_scenes(log, rig, 0.5)))
