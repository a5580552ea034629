"""Trajectories and ego history in the ego frame at the scene's instant.

Ego frame: x forward, y left, z up, metres; heading in radians, counter-clockwise positive.
Rows are poses ``(x, y, z, heading)``, at 10 Hz unless times come with them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]

STEP_S: Final = 0.1
HISTORY_STEPS: Final = 16
"""Rows of an ego history; the last row is the present pose, all zeros (CF-VLA section 7)."""
FUTURE_STEPS: Final = 64
"""Rows of a trajectory; the first row lies 0.1 s ahead (CF-VLA section 7)."""
HORIZON_S: Final = 6.4
POSE_MIRROR: Final = np.array([1, -1, 1, -1], np.float32)
"""Times a pose is its mirror image, left and right swapped; its first two are those of a point (x, y)."""
TEN_HZ_S: Final = tuple(round(STEP_S * step, 1) for step in range(1, FUTURE_STEPS + 1))
"""Times of the poses of a trajectory, unless a model family has its own."""
HALF_SECONDS_S: Final = tuple(0.5 * step for step in range(1, 9))
"""Times of the eight poses of NAVSIM's plans."""
TIMES_OF: Final = {len(times_s): times_s for times_s in (HALF_SECONDS_S, TEN_HZ_S)}
"""Times of plans that are scored, by how many poses they have."""
THREE_SECONDS_S: Final = HALF_SECONDS_S[:6]
"""Times of the six waypoints by which open-loop figures on nuScenes are told."""
MAX_TIME_S: Final = 60.0
ROUTE_POINTS: Final = 20
ROUTE_SPACING_M: Final = 4.0

MAX_POSITION_M: Final = 1000.0
"""No pose within 6.4 s is farther away than this: 156 m/s would be needed."""
_ACCELERATION_STEPS: Final = 10
_PRESENT_TOLERANCE: Final = 1e-3
_SAME_TIME_S: Final = 1e-6


class GeometryError(ValueError):
    """An array that is not a history, trajectory or route; the text says what is wrong."""


def _checked(array: npt.ArrayLike, shape: tuple[int, ...], name: str) -> FloatArray:
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused as such
        values = np.asarray(array, dtype=np.float32)
    if values.shape != shape:
        raise GeometryError(f"{name} must have shape {list(shape)}, got {list(values.shape)}")
    if not np.isfinite(values).all():
        raise GeometryError(f"{name} holds values that are not finite")
    if np.abs(values).max(initial=0.0) > MAX_POSITION_M:
        raise GeometryError(f"{name} holds values beyond ±{MAX_POSITION_M:g}")
    values = values.copy()
    values.flags.writeable = False
    return values


def check_history(array: npt.ArrayLike) -> FloatArray:
    """An ego history as read-only float32 [16, 4], oldest first, last row (0, 0, 0, 0).

    Raises:
        GeometryError: wrong shape, not finite, or a last row that is not the present pose.
    """
    history = _checked(array, (HISTORY_STEPS, 4), "history")
    if np.abs(history[-1]).max() > _PRESENT_TOLERANCE:
        raise GeometryError(
            "history must end at the present pose (0, 0, 0, 0): give it in the ego frame, oldest first"
        )
    return history


def check_trajectory(array: npt.ArrayLike, times_s: Sequence[float] = TEN_HZ_S) -> FloatArray:
    """A trajectory as read-only float32 [64, 4], or [t, 4] at t times; raises `GeometryError`."""
    return _checked(array, (len(times_s), 4), "trajectory")


def check_times(times_s: Sequence[float]) -> None:
    """Raise `GeometryError` unless times ascend from above 0 to at most `MAX_TIME_S`."""
    ascend = all(before < after for before, after in itertools.pairwise((0.0, *times_s)))
    if not times_s or not ascend or times_s[-1] > MAX_TIME_S:
        raise GeometryError(f"times must ascend from above 0 s to at most {MAX_TIME_S:g} s, got {times_s}")


def at_times(trajectory: FloatArray, times_s: Sequence[float], wanted_s: Sequence[float]) -> FloatArray:
    """Where a trajectory [t, 4] with poses at ``times_s`` is at other times: float32 [k, 4].

    Straight lines lead from the present through its poses, and headings turn the short way round.

    Args:
        wanted_s: at most the last of ``times_s``.
    """
    if tuple(wanted_s) == tuple(times_s):
        return trajectory
    poses = np.concatenate([np.zeros((1, 4)), trajectory])
    poses[:, 3] = np.unwrap(poses[:, 3])
    columns = [np.interp(wanted_s, (0.0, *times_s), column) for column in poses.T]
    return np.stack(columns, axis=1).astype(np.float32)


def at_10_hz(trajectory: FloatArray, times_s: Sequence[float]) -> FloatArray:
    """A trajectory [t, 4] at 10 Hz, up to its last pose or to 6.4 s: float32 [k, 4]."""
    return at_times(trajectory, times_s, shared_times(times_s, TEN_HZ_S))


def shared_times(times_s: Sequence[float], others_s: Sequence[float]) -> tuple[float, ...]:
    """Those of ``others_s`` that do not lie behind ``times_s``."""
    return tuple(time_s for time_s in others_s if time_s <= times_s[-1] + _SAME_TIME_S)


def check_route(array: npt.ArrayLike) -> FloatArray:
    """A route as read-only float32 [20, 2], evenly spaced over the next 80 m; raises `GeometryError`."""
    route = _checked(array, (ROUTE_POINTS, 2), "route")
    if np.ptp(route, axis=0).max() < ROUTE_SPACING_M:
        raise GeometryError("route leads nowhere: its points lie one every 4 m along the way to go")
    return route


def wrap_angle(angle: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Angles in radians brought to (-pi, pi]."""
    wrapped: npt.NDArray[np.float64] = -((-np.asarray(angle, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi)
    return wrapped


def to_ego_frame(poses: npt.ArrayLike, present: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """World poses [..., 4] (x, y, z, heading) seen from the pose ``present`` [4].

    Headings are unwrapped along the last time axis by the caller where that matters; here they
    are relative to the present heading and wrapped to (-pi, pi].
    """
    world = np.asarray(poses, dtype=np.float64)
    x0, y0, z0, heading0 = np.asarray(present, dtype=np.float64)
    dx, dy = world[..., 0] - x0, world[..., 1] - y0
    cos, sin = np.cos(heading0), np.sin(heading0)
    return np.stack(
        [
            cos * dx + sin * dy,
            -sin * dx + cos * dy,
            world[..., 2] - z0,
            wrap_angle(world[..., 3] - heading0),
        ],
        axis=-1,
    )


def from_ego_frame(poses: npt.ArrayLike, present: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """World poses [..., 4] of poses (x, y, z, heading) seen from ``present`` [4]: `to_ego_frame` undone."""
    ego = np.asarray(poses, dtype=np.float64)
    x0, y0, z0, heading0 = np.asarray(present, dtype=np.float64)
    cos, sin = np.cos(heading0), np.sin(heading0)
    return np.stack(
        [
            x0 + cos * ego[..., 0] - sin * ego[..., 1],
            y0 + sin * ego[..., 0] + cos * ego[..., 1],
            z0 + ego[..., 2],
            wrap_angle(heading0 + ego[..., 3]),
        ],
        axis=-1,
    )


def present_speed(history: FloatArray) -> float:
    """Signed forward speed in m/s at the present, from the last 0.3 s of a history [16, 4]."""
    return float(-history[-4, 0] / (3 * STEP_S))


def present_acceleration(history: FloatArray) -> float:
    """Change of the signed forward speed in m/s^2 over the last second of a history [16, 4]: its mean."""
    last = history[-_ACCELERATION_STEPS - 1 :].astype(np.float64)
    step, turned = np.diff(last[:, :2], axis=0), wrap_angle(np.diff(last[:, 3]))
    heading = last[:-1, 3] + turned / 2
    along = (step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)) / STEP_S
    times = STEP_S * (np.arange(_ACCELERATION_STEPS) - (_ACCELERATION_STEPS - 1) / 2)
    return float(along @ times / (times @ times))


def at_speed(history: FloatArray, times: float) -> FloatArray:
    """The history [16, 4] of an ego that came the same way at so many times its speed."""
    return history * np.array([times] * 3 + [1.0], np.float32)


def speeds(trajectory: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Signed forward speed in m/s [..., 64] over each step of trajectories [..., 64, 4].

    The sign tells reverse gear: it is that of the displacement along the heading.
    """
    xy = np.asarray(trajectory[..., :2], dtype=np.float64)
    step = np.diff(xy, axis=-2, prepend=np.zeros_like(xy[..., :1, :]))
    heading = np.asarray(trajectory[..., 3], dtype=np.float64)
    along = step[..., 0] * np.cos(heading) + step[..., 1] * np.sin(heading)
    magnitude: npt.NDArray[np.float64] = np.hypot(step[..., 0], step[..., 1]) / STEP_S
    return np.where(along < 0, -magnitude, magnitude)


def retimed(path: FloatArray, pace: FloatArray) -> FloatArray:
    """The way of the trajectory ``path`` [64, 4], driven as far at each time as ``pace`` [64, 4].

    See `paced`.
    """
    return paced(path, speeds(pace))


def paced(path: FloatArray, speeds_ms: npt.NDArray[np.float64]) -> FloatArray:
    """The way of the trajectory ``path`` [64, 4], driven with speeds [64], each over a step.

    Beyond the end of the way, and backwards, it goes straight on.
    """
    poses = np.concatenate([np.zeros((1, 4)), path])
    poses[:, 3] = np.unwrap(poses[:, 3])
    # A part that is driven back and forth counts once.
    along_m = np.maximum.accumulate(np.concatenate([[0.0], np.cumsum(speeds(path)) * STEP_S]))
    end = poses[-1]
    ahead = MAX_POSITION_M * np.array([np.cos(end[3]), np.sin(end[3]), 0.0, 0.0])
    way = np.concatenate([[[-MAX_POSITION_M, 0.0, 0.0, 0.0]], poses, [end + ahead]])
    way_m = np.concatenate([[-MAX_POSITION_M], along_m, [along_m[-1] + MAX_POSITION_M]])
    wanted_m = np.cumsum(speeds_ms) * STEP_S
    return np.stack([np.interp(wanted_m, way_m, column) for column in way.T], axis=1).astype(np.float32)


def constant_velocity(history: FloatArray) -> FloatArray:
    """The trajectory [64, 4] of an ego that keeps speed and heading: a kinematic baseline."""
    time_s = STEP_S * np.arange(1, FUTURE_STEPS + 1)
    baseline = np.zeros((FUTURE_STEPS, 4), np.float32)
    baseline[:, 0] = present_speed(history) * time_s
    return baseline


def constant_turn_rate(history: FloatArray) -> FloatArray:
    """The trajectory [64, 4] of an ego that keeps speed and yaw rate: a kinematic baseline."""
    yaw_rate = float(-history[-6, 3]) / (5 * STEP_S)
    x, y = float(history[-4, 0]), float(history[-4, 1])
    chord_s = 3 * STEP_S
    # The ego came along an arc too, which is longer than its chord.
    speed = float(np.copysign(np.hypot(x, y), -x) / (chord_s * np.sinc(yaw_rate * chord_s / 2 / np.pi)))
    time_s = STEP_S * np.arange(1, FUTURE_STEPS + 1)
    heading = yaw_rate * time_s
    baseline = np.zeros((FUTURE_STEPS, 4), np.float32)
    # The exact arc; sinc keeps it well defined for a yaw rate of zero.
    half = heading / 2
    chord = speed * time_s * np.sinc(half / np.pi)
    baseline[:, 0] = chord * np.cos(half)
    baseline[:, 1] = chord * np.sin(half)
    baseline[:, 3] = heading
    return baseline


def path_length(trajectory: FloatArray) -> float:
    """Metres that a trajectory [t, 4] covers, from the present on."""
    points = np.concatenate([np.zeros((1, 2)), trajectory[:, :2].astype(np.float64)])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def agreed(trajectories: FloatArray) -> int:
    """The place of the trajectory [n, t, 4] that is nearest to all others on average: the draw to drive."""
    apart = np.linalg.norm(trajectories[:, None, :, :2] - trajectories[None, :, :, :2], axis=-1)
    return int(apart.mean(axis=(1, 2)).argmin())
