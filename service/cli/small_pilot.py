"""Small planners in the closed loop."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from looktwice.clients.metadrive.closed_loop import Planned
from looktwice.model.driving.scene import Scene
from looktwice.model.network.reading_planner import ReadingPlanner
from looktwice.model.network.small_planner import SmallPlanner, load_small, small_revision


class SmallPilot:
    """Drives by a small planner's best guess.

    Args:
        folder: of the planner, or of a checkpoint whose small planners sketch.
        by_pictures: the checkpoint's planner of pictures drives; else the one of tracks, without pictures.

    Attributes:
        width_px: of the pictures that it takes; 0 for none.
    """

    def __init__(self, folder: Path, *, by_pictures: bool = False) -> None:
        self._planner: SmallPlanner | ReadingPlanner
        self.needs_pictures = by_pictures
        if by_pictures:
            self._planner, self.name = ReadingPlanner(folder), "pictures"
            self.width_px = self._planner.width_px
        else:
            self._planner, self.width_px = load_small(folder), 0
            self.name = self._planner.kind
        self.revision = small_revision(folder)

    @property
    def described(self) -> str:
        """What manifests of its drives call it."""
        return f"{self.name} {self.revision}"

    def plan(self, scene: Scene) -> Planned:
        """See `Pilot.plan`."""
        began_s = time.perf_counter()
        trajectory = self._planner.plan([scene])[0]
        milliseconds = 1000 * (time.perf_counter() - began_s)
        return Planned(trajectory, np.zeros((0, 64, 4), np.float32), milliseconds=milliseconds)
