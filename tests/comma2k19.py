"""One minute of a real drive (comma2k19) in the ego frame, as a fixture.

Its provenance: tests/data/comma2k19/README.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from model.driving.trajectory import FUTURE_STEPS, HISTORY_STEPS, STEP_S, FloatArray, to_ego_frame

SEGMENT = Path(__file__).parent / "data" / "comma2k19" / "segment_40.npz"

Array = npt.NDArray[np.float64]

_WGS84_SEMI_AXES_M = np.array([6378137.0, 6378137.0, 6356752.3142])


def poses() -> Array:
    """The minute's poses [600, 4] at 10 Hz: x east, y north, z up, metres; heading from east, unwrapped.

    The reference point is the camera, which is fixed to the car, though not quite straight: it looks about
    a degree to the side of where the car goes. Over a minute of road that is the mount, and is taken off.
    """
    with np.load(SEGMENT) as segment:
        times_s = segment["frame_times_s"]
        positions = segment["frame_positions_ecef_m"]
        orientations = segment["frame_orientations_ecef_wxyz"]
    origin = positions[0]
    to_enu = _east_north_up(origin)
    local = (positions - origin) @ to_enu.T
    forward = _camera_forward(orientations) @ to_enu.T
    heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    step = np.diff(local, axis=0)
    course = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    heading += np.median(course - heading[:-1])
    grid_s = np.arange(times_s[0], times_s[-1], STEP_S)
    columns = [*local.T, heading]
    return np.stack([np.interp(grid_s, times_s, column) for column in columns], axis=1)


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


def _east_north_up(place: Array) -> Array:
    """Rows: east, north and up at an ECEF place on the ground. Up is the normal of the WGS 84 ellipsoid."""
    up = place / _WGS84_SEMI_AXES_M**2
    up /= np.linalg.norm(up)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def _camera_forward(quaternions: Array) -> Array:
    """The camera's x axis in ECEF [N, 3] from unit quaternions (w, x, y, z) [N, 4]."""
    w, x, y, z = quaternions.T
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
