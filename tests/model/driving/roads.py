"""Made-up roads as centre lines of lanes, for tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from looktwice.model.driving.scene import LabelledScene, Light
from looktwice.model.driving.trajectory import FloatArray


def arc(radius_m: float, turned_rad: float, start: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    """A line that heads along x at ``start`` and turns to the left, or to the right with a negative angle."""
    angles = np.linspace(0, abs(turned_rad), 12)
    x, y = radius_m * np.sin(angles), radius_m * (1 - np.cos(angles))
    return np.stack([start[0] + x, start[1] + np.copysign(y, turned_rad)], axis=1).astype(np.float32)


def straight(y_m: float, from_m: float = -50.0, to_m: float = 150.0) -> FloatArray:
    """A line along x."""
    return np.stack([np.linspace(from_m, to_m, 40), np.full(40, y_m)], axis=1).astype(np.float32)


def junction() -> tuple[FloatArray, ...]:
    """One lane that leads on to three, 10 m ahead: straight on, to the left and to the right."""
    return (
        straight(0.0, -50, 10),
        straight(0.0, 10, 100),
        arc(12, np.pi / 2, (10.0, 0.0)),
        arc(12, -np.pi / 2, (10.0, 0.0)),
    )


def flipped(lines: tuple[FloatArray, ...]) -> tuple[FloatArray, ...]:
    """Lines or rings [k, 2] in a mirror: left is right."""
    return tuple(np.asarray(line * np.array([1, -1]), np.float32) for line in lines)


def mirrored_scene(labelled: LabelledScene) -> LabelledScene:
    """A labelled scene whose left and right are swapped; pictures stay as they are."""
    scene, poses = labelled.scene, np.array([1, -1, 1, -1], np.float32)
    route = None if scene.route is None else scene.route * poses[:2]
    other: dict[str, Light] = {"left": "right", "right": "left"}
    agents = tuple(
        replace(
            each,
            poses=each.poses * np.array([1, -1, -1], np.float32),
            lights=frozenset(other.get(light, light) for light in each.lights),
        )
        for each in labelled.agents
    )
    return replace(
        labelled,
        scene=replace(scene, history=scene.history * poses, route=route),
        future=labelled.future * poses,
        agents=agents,
        drivable=flipped(labelled.drivable),
        lane_lines=flipped(labelled.lane_lines),
    )
