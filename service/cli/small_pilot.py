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
from looktwice.service.cli.options import SmallInput, small_names


class SmallPilot:
    """Drives by a small planner's best guess.

    Args:
        folder: of the planner, or of a checkpoint whose small planners sketch.
        by: what it plans from. By pictures and by facts the checkpoint's planner of pictures drives: by what
            it reads in them, or by the true facts in their place; by tracks the other one.

    Attributes:
        kind: what it plans from, or the kind of its planner.
        name: of its row in tables: its kind, unless others are of the same kind (`load_pilots`).
        width_px: of the pictures that it takes; 0 for none.
    """

    def __init__(self, folder: Path, by: SmallInput = "tracks") -> None:
        self._plan: Callable[[Sequence[Scene]], FloatArray]
        self.kind: str = by
        self.needs_pictures, self.width_px = by == "pictures", 0
        if by == "tracks":
            planner = load_small(folder)
            self._plan, self.kind = planner.plan, planner.kind
        elif by == "facts":
            self._plan = ReadingPlanner(folder).plan_by_facts
        else:
            reading = ReadingPlanner(folder)
            self._plan, self.width_px = reading.plan, reading.width_px
        self.name: str = self.kind
        self.revision = small_revision(folder)

    @property
    def described(self) -> str:
        """What manifests of its drives call it."""
        return f"{self.kind} {self.revision}"

    def plan(self, scene: Scene) -> Planned:
        """See `Pilot.plan`."""
        began_s = time.perf_counter()
        trajectory = self._plan([scene])[0]
        milliseconds = 1000 * (time.perf_counter() - began_s)
        return Planned(trajectory, np.zeros((0, 64, 4), np.float32), milliseconds=milliseconds)


def load_pilots(folders: Sequence[Path], by: SmallInput) -> dict[str, SmallPilot]:
    """Small planners that drive, each under a name of its own.

    Raises:
        ValueError: see `SmallPilot` and `small_names`.
    """
    pilots = [SmallPilot(folder, by) for folder in folders]
    for pilot, name in zip(pilots, small_names([pilot.kind for pilot in pilots], folders), strict=True):
        pilot.name = name
    return {pilot.name: pilot for pilot in pilots}
