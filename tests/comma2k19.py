"""One minute of a real drive (comma2k19) in the ego frame, as a fixture.

Its provenance: tests/data/comma2k19/README.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from looktwice.clients.importers.comma2k19 import read_segments
from looktwice.clients.importers.recording import Array
from looktwice.model.driving.trajectory import FUTURE_STEPS, HISTORY_STEPS, STEP_S, FloatArray, to_ego_frame

SEGMENT = Path(__file__).parent / "data" / "comma2k19" / "segment_40"


def poses() -> Array:
    """The minute's poses [600, 4] at 10 Hz: x east, y north, z up, metres; heading from east, unwrapped."""
    (minute,) = read_segments(SEGMENT, ())
    return minute.at(np.arange(minute.times_s[0], minute.times_s[-1], STEP_S))


def windows(every: int = 5) -> tuple[FloatArray, FloatArray]:
    """Histories [N, 16, 4] and futures [N, 64, 4] around every ``every``-th pose, in the ego frame there."""
    world = poses()
    presents = range(HISTORY_STEPS - 1, len(world) - FUTURE_STEPS, every)
    seen = np.stack(
        [
            to_ego_frame(world[now - HISTORY_STEPS + 1 : now + FUTURE_STEPS + 1], world[now])
            for now in presents
        ]
    ).astype(np.float32)
    return seen[:, :HISTORY_STEPS], seen[:, HISTORY_STEPS:]
