"""Labelled scenes drawn by hand: a straight road, a slow leader, an oncoming car and a walker."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image, ImageDraw

from looktwice.model.driving.scene import (
    CLIP_FRAMES,
    FRONT_TELE,
    FRONT_WIDE,
    Agent,
    AgentKind,
    Clip,
    LabelledScene,
    Scene,
)
from looktwice.model.driving.trajectory import FloatArray

SPEED_MPS = 12.0


def picture(camera: str, frame: int) -> bytes:
    """A road that runs to the horizon, a leader that grows from frame to frame; JPEG."""
    width, height = 224, 128
    image = Image.new("RGB", (width, height), (146, 186, 222))
    draw = ImageDraw.Draw(image)
    horizon = 56
    spread = 150 if camera == FRONT_WIDE else 90
    draw.rectangle((0, horizon, width, height), fill=(98, 128, 84))
    draw.polygon([(112, horizon), (112 - spread, height), (112 + spread, height)], fill=(74, 76, 80))
    draw.line([(112, horizon), (112 - spread // 3, height)], fill=(236, 236, 228), width=2)
    size = (5 if camera == FRONT_WIDE else 18) + 2 * frame
    draw.rectangle((118, 62 - size // 3, 118 + 2 * size, 62 + size), fill=(176, 40, 36))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=80)
    return buffer.getvalue()


def history(speed_mps: float = SPEED_MPS) -> FloatArray:
    rows = np.zeros((16, 4), np.float32)
    rows[:, 0] = speed_mps * 0.1 * np.arange(-15, 1)
    return rows


def scene(scene_id: str = "hand-made", cameras: tuple[str, ...] = (FRONT_WIDE, FRONT_TELE)) -> Scene:
    route = np.zeros((20, 2), np.float32)
    route[:, 0] = 4.0 * np.arange(1, 21)
    return Scene(
        scene_id=scene_id,
        clips=tuple(
            Clip(camera, tuple(picture(camera, frame) for frame in range(CLIP_FRAMES))) for camera in cameras
        ),
        history=history(),
        route=route,
    )


def agent(agent_id: int, kind: AgentKind, start: tuple[float, float], velocity: tuple[float, float]) -> Agent:
    seconds = 0.1 * np.arange(-15, 65)
    poses = np.zeros((80, 3), np.float32)
    poses[:, 0] = start[0] + velocity[0] * seconds
    poses[:, 1] = start[1] + velocity[1] * seconds
    poses[:, 2] = np.arctan2(velocity[1], velocity[0])
    size = (4.5, 1.9, 1.5) if kind == "vehicle" else (0.6, 0.6, 1.8)
    return Agent(agent_id, kind, *size, poses)


def labelled(scene_id: str = "hand-made", seed: int = 600_001) -> LabelledScene:
    future = np.zeros((64, 4), np.float32)
    seconds = 0.1 * np.arange(1, 65)
    future[:, 0] = SPEED_MPS * seconds - 0.35 * seconds**2
    future[:, 1] = 3.5 / (1 + np.exp(-2 * (seconds - 3.2)))
    future[:, 3] = np.gradient(future[:, 1], future[:, 0])
    walker = agent(3, "pedestrian", (46.0, -8.5), (0.0, 0.9))
    walker.poses[:4] = np.nan
    road = np.array([[-40, -5.5], [120, -5.5], [120, 9.0], [-40, 9.0]], np.float32)
    lines = [np.array([[-40, y], [120, y]], np.float32) for y in (-3.5, 0.0, 3.5, 7.0)]
    return LabelledScene(
        scene=scene(scene_id),
        episode_id="episode-1",
        seed=seed,
        future=future,
        agents=(
            agent(1, "vehicle", (24.0, 0.0), (7.0, 0.0)),
            agent(2, "vehicle", (70.0, 7.0), (-10.0, 0.0)),
            walker,
        ),
        drivable=(road,),
        lane_lines=tuple(lines),
        tags=frozenset({"lead_vehicle", "lane_change"}),
    )
