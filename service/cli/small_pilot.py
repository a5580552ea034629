"""Small planners in the closed loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from looktwice.clients.metadrive.closed_loop import Planned
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.network.reading_planner import ReadingPlanner
from looktwice.model.network.small_planner import load_small, small_revision
from looktwice.service.cli.options import SmallInput


class SmallPilot:
    """Drives by a small planner's best guess.

    Args:
        folder: of the planner, or of a checkpoint whose small planners sketch.
        by: what it plans from. By pictures and by facts the checkpoint's planner of pictures drives: by what
            it reads in them, or by the true facts in their place; by tracks the other one.

    Attributes:
        width_px: of the pictures that it takes; 0 for none.
    """

    def __init__(self, folder: Path, by: SmallInput = "tracks") -> None:
        self._plan: Callable[[Sequence[Scene]], FloatArray]
        self.name: str = by
        self.needs_pictures, self.width_px = by == "pictures", 0
        if by == "tracks":
            planner = load_small(folder)
            self._plan, self.name = planner.plan, planner.kind
        elif by == "facts":
            self._plan = ReadingPlanner(folder).plan_by_facts
        else:
            reading = ReadingPlanner(folder)
            self._plan, self.width_px = reading.plan, reading.width_px
        self.revision = small_revision(folder)

    @property
    def described(self) -> str:
        """What manifests of its drives call it."""
        return f"{self.name} {self.revision}"

    def plan(self, scene: Scene) -> Planned:
        """See `Pilot.plan`."""
        began_s = time.perf_counter()
        trajectory = self._plan([scene])[0]
        milliseconds = 1000 * (time.perf_counter() - began_s)
        return Planned(trajectory, np.zeros((0, 64, 4), np.float32), milliseconds=milliseconds)
