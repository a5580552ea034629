"""Made-up drives for tests: from speed and yaw rate to poses, and labelled scenes around them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.images import encode_jpeg
from looktwice.model.driving.scene import (
    FRONT_TELE,
    FRONT_WIDE,
    TRACK_STEPS,
    Agent,
    AgentKind,
    Clip,
    LabelledScene,
    LaneTrace,
    Scene,
)
from looktwice.model.driving.trajectory import FUTURE_STEPS, HISTORY_STEPS, STEP_S, FloatArray, to_ego_frame

Array = npt.NDArray[np.float64]

MIDDLES_S: Array = np.linspace(-(HISTORY_STEPS - 1.5), FUTURE_STEPS - 0.5, TRACK_STEPS - 1) * STEP_S
"""Middle of each of the 79 steps between poses, seconds from now."""
ROWS_S: Array = np.linspace(-(HISTORY_STEPS - 1), FUTURE_STEPS, TRACK_STEPS) * STEP_S
"""Time of each of the 80 poses, seconds from now."""


def drive(speed: npt.ArrayLike, yaw_rate: npt.ArrayLike = 0.0) -> tuple[FloatArray, FloatArray]:
    """Future [64, 4] and history [16, 4] of an ego with these speeds and yaw rates [79] (or constants)."""
    v = np.broadcast_to(np.asarray(speed, np.float64), MIDDLES_S.shape)
    turned = np.broadcast_to(np.asarray(yaw_rate, np.float64), MIDDLES_S.shape) * STEP_S
    heading = np.concatenate([[0.0], np.cumsum(turned)])
    # The chord of each step's arc, so that constant speed and yaw rate give an exact circle.
    chord = v * STEP_S * np.sinc(turned / 2 / np.pi)
    middle = heading[:-1] + turned / 2
    poses = np.zeros((TRACK_STEPS, 4))
    poses[1:, 0] = np.cumsum(chord * np.cos(middle))
    poses[1:, 1] = np.cumsum(chord * np.sin(middle))
    poses[:, 3] = heading
    seen = to_ego_frame(poses, poses[HISTORY_STEPS - 1]).astype(np.float32)
    return seen[HISTORY_STEPS:], seen[:HISTORY_STEPS]


def mirrored(poses: npt.NDArray[np.floating]) -> FloatArray:
    """Poses [..., 4] seen in a mirror: left is right."""
    return np.asarray(poses * np.array([1, -1, 1, -1]), np.float32)


def picture(seed: int = 0, width: int = 32, height: int = 16) -> bytes:
    """A small JPEG; another seed, another picture."""
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return encode_jpeg(pixels)


def clips(seed: int = 0) -> tuple[Clip, Clip]:
    """The two clips of CF-VLA, eight different pictures."""
    wide = tuple(picture(10 * seed + i) for i in range(4))
    tele = tuple(picture(10 * seed + 4 + i) for i in range(4))
    return Clip(FRONT_WIDE, wide), Clip(FRONT_TELE, tele)


def agent(
    x: float,
    y: float,
    speed: float = 0.0,
    heading: float = 0.0,
    kind: AgentKind = "vehicle",
    agent_id: int = 1,
    size_m: tuple[float, float, float] = (4.4, 1.8, 1.5),
) -> Agent:
    """A box that is at (x, y) now and moves along its heading at constant speed."""
    away = speed * ROWS_S
    poses = np.stack(
        [x + away * np.cos(heading), y + away * np.sin(heading), np.full(TRACK_STEPS, heading)], 1
    )
    return Agent(agent_id, kind, *size_m, poses.astype(np.float32))


def rectangle(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    """A closed ring [4, 2]."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], np.float32)


def straight_lane() -> LaneTrace:
    """The middle one of three lanes, kept."""
    return LaneTrace(
        np.zeros(TRACK_STEPS, np.int32), np.ones(TRACK_STEPS, np.int16), np.zeros(TRACK_STEPS, np.float32)
    )


def labelled_scene(
    speed: npt.ArrayLike = 10.0,
    yaw_rate: npt.ArrayLike = 0.0,
    *,
    scene_id: str = "scene",
    episode_id: str = "episode",
    agents: tuple[Agent, ...] = (),
    pictures: int = 0,
) -> LabelledScene:
    """A labelled scene on a straight three-lane road around a made-up drive."""
    future, history = drive(speed, yaw_rate)
    route = np.stack([4.0 * np.arange(1, 21), np.zeros(20)], 1).astype(np.float32)
    lines = tuple(np.array([[-50, y], [150, y]], np.float32) for y in (-3.5, 0.0, 3.5))
    return LabelledScene(
        scene=Scene(scene_id, clips(pictures), history, route),
        episode_id=episode_id,
        seed=500_001,
        future=future,
        agents=agents,
        drivable=(rectangle(-50, -5.25, 150, 5.25),),
        lane_lines=lines,
        lane_trace=straight_lane(),
        tags=frozenset({"lead_vehicle"}) if agents else frozenset(),
    )
