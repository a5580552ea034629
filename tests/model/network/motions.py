"""Made-up motions for tests: smooth speeds and curvatures, standstill, reverse and lane changes included."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.trajectory import FUTURE_STEPS, HISTORY_STEPS, STEP_S

FloatArray = npt.NDArray[np.float32]


def made_up_motions(count: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Histories float32 [n, 16, 4] and futures float32 [n, 64, 4] of cars that move plausibly."""
    random = np.random.default_rng(seed)
    steps = HISTORY_STEPS - 1 + FUTURE_STEPS
    speed = random.uniform(0, 25, (count, 1)) + np.cumsum(_wander(random, count, steps, 2.0) * STEP_S, axis=1)
    speed = np.maximum(speed, 0)
    kind = random.integers(0, 12, count)
    speed[kind == 0] = 0
    speed[kind == 1] = -np.minimum(speed[kind == 1], 2)
    # Sideways acceleration stays below 3 m/s^2.
    curvature = _wander(random, count, steps, 0.03)
    yaw_rate = np.clip(curvature * speed, -3 / np.maximum(np.abs(speed), 1), 3 / np.maximum(np.abs(speed), 1))
    heading = np.cumsum(yaw_rate * STEP_S, axis=1)
    middle = heading - yaw_rate * STEP_S / 2
    x, y = (
        np.cumsum(speed * np.cos(middle) * STEP_S, axis=1),
        np.cumsum(speed * np.sin(middle) * STEP_S, axis=1),
    )
    poses = np.stack([x, y, np.zeros_like(x), heading], axis=-1)
    poses = np.concatenate([np.zeros((count, 1, 4)), poses], axis=1)
    present = poses[:, HISTORY_STEPS - 1 : HISTORY_STEPS]
    moved = poses - present
    cos, sin = np.cos(present[..., 3]), np.sin(present[..., 3])
    ego = moved.copy()
    ego[..., 0] = cos * moved[..., 0] + sin * moved[..., 1]
    ego[..., 1] = cos * moved[..., 1] - sin * moved[..., 0]
    poses32 = ego.astype(np.float32)
    return poses32[:, :HISTORY_STEPS], poses32[:, HISTORY_STEPS:]


def _wander(random: np.random.Generator, count: int, steps: int, size: float) -> npt.NDArray[np.float64]:
    """Smooth noise [n, steps]: cubic interpolation would do as well, cosine halves are simpler."""
    knots = random.normal(0, size, (count, steps // 20 + 2))
    place = np.arange(steps) / 20
    left, part = place.astype(int), (1 - np.cos(np.pi * (place % 1))) / 2
    return knots[:, left] * (1 - part) + knots[:, left + 1] * part
