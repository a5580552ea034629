"""The rule-based labeller: from an expert's motion to its plan.

CF-VLA (section 4.1) labels meta-actions "through rule-based detectors operating on kinematic profiles" at
10 Hz and publishes no thresholds. Those below are ours; each says why. All detectors see the 1.5 s before the
present too, so a plan does not begin with the artefacts of a filter that begins there.

Every detector is odd in left and right: the plan of a mirrored drive is the mirrored plan.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.plan import TICKS, Plan, Track, track_from_words
from looktwice.model.driving.scene import LabelledScene, LaneTrace
from looktwice.model.driving.trajectory import HISTORY_STEPS, STEP_S, check_history, check_trajectory

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MIN_DURATION: Final = 5
"""Ticks (0.5 s): a shorter segment is absorbed. It is about a driver's reaction time, so nothing shorter was
meant; it also bounds a track to 12 segments."""

SPEED_WINDOW: Final = 5
"""Steps to each side that smooth the speed and the yaw rate: 1.1 s of Hann weights, about 0.5 s effective,
which is the shortest duration we label."""
ACCELERATION_WINDOW: Final = 8
"""Steps to each side whose slope is the acceleration: wider, because a slope amplifies noise more."""

ACCELERATION_ENTER: Final = 0.4
"""m/s^2. Everyday pulling away and braking is 1-2 m/s^2 and engine drag or a slope 0.1-0.3 m/s^2; the same
value served in the pilot's labels."""
ACCELERATION_LEAVE: Final = 0.2
"""m/s^2. Half of the above: pedal work is rarely smoother than that."""
MIN_SPEED_CHANGE: Final = 0.5
"""m/s. What changes the speed by less (2 km/h) is holding a speed by hand."""

WAIT_ENTER: Final = 0.3
"""m/s. Below walking pace by a factor of four; above the noise of a standing car's localisation."""
WAIT_LEAVE: Final = 0.5
"""m/s. Creeping up by less than this is still waiting."""

CURVATURE_ENTER: Final = 1 / 160
"""1/m. Roads for 70 km/h and more are laid out with radii above about 200 m, and following them is Straight.
A bend of 160 m turns by 38 degrees in 6.4 s at 60 km/h: the plan must speak of it."""
CURVATURE_LEAVE: Final = 1 / 240
"""1/m. Two thirds of the above."""
CURVATURE_MIN_SPEED: Final = 2.0
"""m/s. Below it the curvature is the yaw rate over this speed, so a standing car's noise is not a turn."""
MIN_HEADING_CHANGE: Final = float(np.deg2rad(15))
"""A turn changes the heading by at least this much; a lane change at 40 km/h swings by under 10 degrees."""

LANE_CHANGE_SWING: Final = float(np.deg2rad(45))
"""Steering for a lane change swings the heading there and back, at walking pace by up to this much; it is no
turn. More than this is one, even when the ego changes lanes meanwhile."""

LANE_MOVING: Final = 0.2
"""m/s sideways. Wandering within the lane stays below; a lane change of 3.5 m in 4 s peaks at 1.6 m/s."""
LANE_SETTLED: Final = 0.6
"""m from the new lane's centre. A lane change that pauses farther out than this has not ended."""
LANE_MIN_SHIFT: Final = 1.0
"""m sideways during a lane change; less is riding on the line."""
LANE_SIDE_MAX: Final = 40
"""Steps (4 s) that a lane change may reach to each side of the moment the lane number changes."""

KEEP_LANE: Final = "Keep Lane"


def label_plan(future: npt.ArrayLike, history: npt.ArrayLike, lane_trace: LaneTrace | None) -> Plan:
    """The plan that an expert's motion carries out.

    Args:
        future: float32 [64, 4], the expert's trajectory.
        history: float32 [16, 4], where it came from.
        lane_trace: its lanes over time; without one, or where a lane of the future is unknown (-1), the
            plan has no lane group.

    Returns:
        A plan with segments of at least 0.5 s, hence at most 12 a track.

    Raises:
        GeometryError: arrays that are not a trajectory and a history.
    """
    poses = np.concatenate([check_history(history), check_trajectory(future)]).astype(np.float64)
    step = np.diff(poses, axis=0)
    turned = np.arctan2(np.sin(step[:, 3]), np.cos(step[:, 3]))
    heading = poses[:-1, 3] + turned / 2
    # Along the heading, so that reversing is negative and sliding sideways is no speed.
    raw_speed = (step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)) / STEP_S
    speed = _smoothed(raw_speed, SPEED_WINDOW)
    lane = None if lane_trace is None else _lane(lane_trace)
    changing = np.array([word != KEEP_LANE for word in lane or [KEEP_LANE] * len(speed)])
    return Plan(
        longitudinal=labelled_track(_longitudinal(speed, _slope(raw_speed, ACCELERATION_WINDOW))),
        lateral=labelled_track(_lateral(_smoothed(turned / STEP_S, SPEED_WINDOW), speed, changing)),
        lane=None if lane is None else labelled_track(lane),
    )


def expert_plan(labelled: LabelledScene) -> Plan:
    """The plan that the expert of a labelled scene carries out."""
    return label_plan(labelled.future, labelled.scene.history, labelled.lane_trace)


def _longitudinal(speed: Array, acceleration: Array) -> list[str]:
    words = np.full(len(speed), "Keep Speed", dtype=object)
    for word, towards in (("Accelerate", acceleration), ("Decelerate", -acceleration)):
        for start, end in _runs(_hysteresis(towards, ACCELERATION_ENTER, ACCELERATION_LEAVE)):
            if towards[start:end].sum() * STEP_S >= MIN_SPEED_CHANGE:
                words[start:end] = word
    words[speed < 0] = "Reverse"
    words[_hysteresis(-np.abs(speed), -WAIT_ENTER, -WAIT_LEAVE)] = "Wait"
    return list(words)


def _lateral(yaw_rate: Array, speed: Array, changing: BoolArray) -> list[str]:
    words = np.full(len(speed), "Straight", dtype=object)
    curvature = yaw_rate / np.maximum(np.abs(speed), CURVATURE_MIN_SPEED)
    for word, sign in (("Left Turn", 1), ("Right Turn", -1)):
        for start, end in _runs(_hysteresis(sign * curvature, CURVATURE_ENTER, CURVATURE_LEAVE)):
            swing = LANE_CHANGE_SWING if changing[start:end].mean() > 0.5 else MIN_HEADING_CHANGE
            if sign * yaw_rate[start:end].sum() * STEP_S >= swing:
                words[start:end] = word
    return list(words)


def _lane(trace: LaneTrace) -> list[str] | None:
    known = (trace.lane >= 0) & (trace.road >= 0)
    if not known[HISTORY_STEPS - 1 :].all():
        return None
    same_road = known[1:] & known[:-1] & (np.diff(trace.road) == 0)
    crossing = np.where(same_road, np.sign(np.diff(trace.lane)), 0)
    offset = trace.offset_m.astype(np.float64)
    sideways = _smoothed(_sideways_speed(offset, (crossing == 0) & same_road), SPEED_WINDOW)
    words = np.full(len(sideways), KEEP_LANE, dtype=object)
    for step in np.flatnonzero(crossing).tolist():
        # Lane 0 is the leftmost: a number that goes down is a change to the left.
        left = crossing[step] < 0
        towards = sideways if left else -sideways
        start = end = step
        while start > max(0, step - LANE_SIDE_MAX) and towards[start - 1] > LANE_MOVING:
            start -= 1
        while end < min(len(towards), step + LANE_SIDE_MAX) and (
            towards[end] > LANE_MOVING or abs(offset[end + 1]) > LANE_SETTLED
        ):
            end += 1
        if towards[start:end].sum() * STEP_S >= LANE_MIN_SHIFT:
            words[start:end] = "Left Lane Change" if left else "Right Lane Change"
    return list(words)


def _sideways_speed(offset: Array, usable: BoolArray) -> Array:
    """Speed to the left [79] from offsets [80]; where the centre line jumps, that of the steps around."""
    speed = np.diff(offset) / STEP_S
    steps = np.arange(len(speed))
    if not usable.any():
        return np.zeros_like(speed)
    return np.interp(steps, steps[usable], speed[usable])


def labelled_track(words: list[str]) -> Track:
    """Words, of which the last 64 are of the steps ahead, as a track without actions below `MIN_DURATION`."""
    return track_from_words(_absorb_short(words[-TICKS:]))


def _absorb_short(words: list[str]) -> list[str]:
    """Give runs shorter than `MIN_DURATION`, the shortest first, to their longer neighbour."""
    words = list(words)
    while True:
        edges = [0, *(i for i in range(1, len(words)) if words[i] != words[i - 1]), len(words)]
        runs = list(pairwise(edges))
        length, index = min((end - start, index) for index, (start, end) in enumerate(runs))
        if len(runs) == 1 or length >= MIN_DURATION:
            return words
        neighbours = [runs[other] for other in (index - 1, index + 1) if 0 <= other < len(runs)]
        taker = max(neighbours, key=lambda run: run[1] - run[0])
        start, end = runs[index]
        words[start:end] = [words[taker[0]]] * length


def _hysteresis(signal: Array, enter: float, leave: float) -> BoolArray:
    """True from where ``signal`` exceeds ``enter`` until it falls below ``leave``."""
    on: list[bool] = []
    state = False
    for value in signal.tolist():  # Python's own floats compare several times faster than numpy's.
        state = value > (leave if state else enter)
        on.append(state)
    return np.array(on, np.bool_)


def _runs(on: BoolArray) -> list[tuple[int, int]]:
    framed = np.zeros(len(on) + 2, np.bool_)
    framed[1:-1] = on
    edges = np.flatnonzero(framed[1:] != framed[:-1])
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _smoothed(signal: Array, half: int) -> Array:
    result: Array = _local_lines(len(signal), half)[0] @ signal
    return result


def _slope(signal: Array, half: int) -> Array:
    """Change per second."""
    result: Array = _local_lines(len(signal), half)[1] @ signal / STEP_S
    return result


@cache
def _local_lines(count: int, half: int) -> tuple[Array, Array]:
    """Matrices [count, count] that give value and slope of a Hann-weighted line through each neighbourhood.

    A line, not a mean: at both ends, where the neighbourhood is one-sided, a mean would lag behind.
    """
    away = (np.arange(count)[None, :] - np.arange(count)[:, None]).astype(np.float64)
    weight = np.where(np.abs(away) <= half, np.cos(np.pi * away / (2 * half + 2)) ** 2, 0.0)
    weight /= weight.sum(axis=1, keepdims=True)
    first = (weight * away).sum(axis=1, keepdims=True)
    second = (weight * away**2).sum(axis=1, keepdims=True)
    slope = weight * (away - first) / (second - first**2)
    return weight - slope * first, slope
