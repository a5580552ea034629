"""Between the contract's messages and ours. The messages are those that `carla-driver-interface` carries."""

from __future__ import annotations

import json
import math
import pickle
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from carla_driver_interface.protocol import (
    DriveResponse,
    Pose,
    PoseAtTime,
    Quat,
    Route,
    Trajectory,
    Vec3,
)

from looktwice.clients.alpasim.driver import Driven
from looktwice.clients.alpasim.egomotion import STEP_US, Observed
from looktwice.clients.alpasim.errors import BadObservation
from looktwice.model.driving.trajectory import FloatArray, from_ego_frame

DebugFormat = Literal["json", "pickle"]
_NO_ROTATION: Final = (0.0, 0.0, 0.0, 1.0)


def observed(pose: Pose) -> Observed:
    """A pose of the rig in the runtime's world; raises `BadObservation` where it is not finite."""
    place = (pose.vec.x, pose.vec.y, pose.vec.z)
    rotation = (pose.quat.x, pose.quat.y, pose.quat.z, pose.quat.w)
    if not all(map(math.isfinite, place + rotation)):
        raise BadObservation("a pose holds values that are not finite")
    length = math.hypot(*rotation)
    # A message in which nobody set a rotation holds zeros.
    x, y, z, w = _NO_ROTATION if length < 1e-9 else (value / length for value in rotation)
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return Observed((*place, heading), (x, y, z, w))


def waypoints(route: Route) -> npt.NDArray[np.float64]:
    """A route's waypoints [n, 2]."""
    return np.array([(point.x, point.y) for point in route.waypoints], np.float64).reshape(-1, 2)


def drive_response(driven: Driven | None, now_us: int, debug_format: DebugFormat) -> DriveResponse:
    """The answer to a drive: an empty trajectory where there is no plan yet.

    ``terminate_session`` is never set: when a rollout ends is not the driver's to say.
    """
    if driven is None:
        return DriveResponse(trajectory=Trajectory())
    sampled = [trajectory(driven.moment.present, draw, now_us) for draw in driven.trajectories]
    return DriveResponse(
        trajectory=sampled[driven.chosen],
        debug_info=DriveResponse.DebugInfo(
            unstructured_debug_info=_packed(driven, debug_format), sampled_trajectories=sampled
        ),
    )


def trajectory(present: Observed, draw: FloatArray, now_us: int) -> Trajectory:
    """A draw [64, 4] in the runtime's world: the present pose first, then one every 0.1 s."""
    x, y, z, w = present.rotation
    poses = [_pose_at(now_us, present.pose[:3], Quat(x=x, y=y, z=z, w=w))]
    for step, row in enumerate(from_ego_frame(draw, present.pose).tolist(), start=1):
        half = row[3] / 2
        upright = Quat(z=math.sin(half), w=math.cos(half))
        poses.append(_pose_at(now_us + step * STEP_US, (row[0], row[1], row[2]), upright))
    return Trajectory(poses=poses)


def _pose_at(time_us: int, place: tuple[float, float, float], rotation: Quat) -> PoseAtTime:
    x, y, z = place
    return PoseAtTime(timestamp_us=time_us, pose=Pose(vec=Vec3(x=x, y=y, z=z), quat=rotation))


def _packed(driven: Driven, debug_format: DebugFormat) -> bytes:
    # alpasim's own evaluation unpickles a dict, where it is told to trust the driver; it holds builtins only.
    if debug_format == "pickle":
        return pickle.dumps(driven.debug)
    return json.dumps(driven.debug).encode()
