"""High-level planning: what a trajectory does in one word for speed and one for direction.

ELF-VLA (supplement, section 9.1 and figure 9) tells four longitudinal states by "acceleration via a sliding
window" and five lateral manoeuvres by "the alignment between the future path and the lane structure" of a
road topology graph. It publishes no thresholds. Those below are ours; each says why.

All is odd in left and right: the action of a mirrored trajectory on a mirrored road is the mirrored action.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.labeller import ACCELERATION_ENTER, MIN_HEADING_CHANGE, WAIT_LEAVE
from looktwice.model.driving.lane_graph import LaneGraph, LanePath
from looktwice.model.driving.lead import LANE_HALF_WIDTH_M
from looktwice.model.driving.trajectory import TEN_HZ_S, FloatArray, GeometryError, at_times, wrap_angle

Array = npt.NDArray[np.float64]
Longitudinal = Literal["accelerate", "decelerate", "maintain", "stop"]
Lateral = Literal["keep", "turn left", "turn right", "change left", "change right"]

STEP_S: Final = 0.5
HORIZON_S: Final = 4.0
"""NAVSIM's horizon and its step. Longer trajectories are judged by these poses, so that all are alike."""
WINDOW_STEPS: Final = 4
"""Steps (2 s) of the sliding window: poses written in decimetres then give 0.1 m/s^2, a quarter of what
counts as accelerating, and a driver's shift from one pedal to the other does not count."""
ACCELERATING_MS2: Final = ACCELERATION_ENTER
"""m/s^2: as in plans (`looktwice.model.driving.labeller`)."""
STOPPED_MS: Final = WAIT_LEAVE
"""m/s over the last step: as slow as this waits, in plans too."""
TURNED_RAD: Final = MIN_HEADING_CHANGE
"""A way through a junction that turns by less goes straight on; the same angle as in plans."""
OFF_LANE_RAD: Final = float(np.deg2rad(30))
"""Who heads this far away from the lane turns where no lane does; a lane change swings by under 10 degrees at
40 km/h, and by 25 degrees at walking pace."""
MOVED_M: Final = 2.0
"""Over less than half a car's length, a direction is noise."""

_TIMES_S: Final = tuple(STEP_S * step for step in range(1, round(HORIZON_S / STEP_S) + 1))
_OTHER_SIDE: Final[dict[Lateral, Lateral]] = {
    "turn left": "turn right",
    "turn right": "turn left",
    "change left": "change right",
    "change right": "change left",
}


@dataclass(frozen=True)
class HighLevelAction:
    """What is done within `HORIZON_S`: one of four states of speed, one of five manoeuvres."""

    longitudinal: Longitudinal
    lateral: Lateral

    def mirrored(self) -> HighLevelAction:
        """The same with left and right swapped."""
        return replace(self, lateral=_OTHER_SIDE.get(self.lateral, self.lateral))


def action_of(
    trajectory: FloatArray, graph: LaneGraph, times_s: Sequence[float] = TEN_HZ_S
) -> HighLevelAction | None:
    """What a trajectory [t, 4] does on a road; None where the ego is on none of its lanes.

    Raises:
        GeometryError: the trajectory ends before `HORIZON_S`.
    """
    poses = _poses(trajectory, times_s)
    way = graph.path_along(poses[:, :2])
    return None if way is None else HighLevelAction(_longitudinal(poses), _lateral(poses, way))


def _poses(trajectory: FloatArray, times_s: Sequence[float]) -> Array:
    """Poses [9, 4] from the present on, every `STEP_S`."""
    if times_s[-1] < HORIZON_S:
        raise GeometryError(
            f"a trajectory must reach {HORIZON_S:g} s to be judged, it ends at {times_s[-1]:g} s"
        )
    return np.concatenate([np.zeros((1, 4)), at_times(trajectory, times_s, _TIMES_S).astype(np.float64)])


def _longitudinal(poses: Array) -> Longitudinal:
    step = np.diff(poses, axis=0)
    heading = poses[:-1, 3] + wrap_angle(step[:, 3]) / 2
    # Along the heading, so that reversing is negative.
    speeds = (step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)) / STEP_S
    if abs(speeds[-1]) < STOPPED_MS:
        return "stop"
    windows = np.lib.stride_tricks.sliding_window_view(speeds, WINDOW_STEPS)
    times = STEP_S * (np.arange(WINDOW_STEPS) - (WINDOW_STEPS - 1) / 2)
    slopes = windows @ times / (times @ times)
    strongest = float(slopes[int(np.abs(slopes).argmax())])
    if abs(strongest) < ACCELERATING_MS2:
        return "maintain"
    return "accelerate" if strongest > 0 else "decelerate"


def _lateral(poses: Array, way: LanePath) -> Lateral:
    path = poses[:, :2]
    if np.linalg.norm(np.diff(path, axis=0), axis=1).sum() < MOVED_M:
        return "keep"
    turned = float(np.unwrap(poses[:, 3])[-1])
    off_lane = float(wrap_angle(poses[-1, 3] - way.frame.headings(path[-1:])[0]))
    if abs(off_lane) > OFF_LANE_RAD:
        return "turn left" if off_lane > 0 else "turn right"
    if way.at_fork and abs(turned) > TURNED_RAD:
        return "turn left" if turned > 0 else "turn right"
    left_m = float(way.frame.places(path[-1:])[0, 1])
    if abs(left_m) > LANE_HALF_WIDTH_M:
        return "change left" if left_m > 0 else "change right"
    return "keep"
