"""Who comes into a camera's view within half a second, and whether a picture of that moment shows it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.agents import Agent
from looktwice.model.driving.cameras import CAMERA_SPECS, CameraSpec
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.short_term import AHEAD_S
from looktwice.model.driving.trajectory import STEP_S
from looktwice.model.engines.engine import Engine
from looktwice.model.evaluation.next_frames import Painter, imagined_codes, warped, what_came
from looktwice.model.evaluation.variants import Variant, cameras_ahead, over_scenes, planned, request_for
from looktwice.model.network.visual_codes import FRAME_HEIGHT, FRAME_WIDTH, Frame

Array = npt.NDArray[np.float64]

_STEP: Final = round(AHEAD_S / STEP_S) - 1
"""The row of a future that is half a second ahead."""
_NEAREST_M: Final = 0.5
"""Corners that are nearer to the camera's plane, or behind it, are left out."""
_MOST_NOW: Final = 0.25
"""Who enters is seen now by at most this share of its columns."""
_LEAST_PX: Final = 12
"""Columns and rows that it has in the picture then: less is a speck, even in a picture without codes."""
_LEAST_CHANGE: Final = 10.0
"""Grey levels by which what came differs there, on average, from the moved picture: who is hidden, or looks
like the road, changes nothing."""


@dataclass(frozen=True)
class Entering:
    """Somebody who enters a view.

    Attributes:
        camera: whose view it is.
        agent_id: who.
        left, top, right, bottom: pixels of a picture of 224 x 112 that show the box then; the latter two are
            the first ones beyond.
    """

    camera: str
    agent_id: int
    left: int
    top: int
    right: int
    bottom: int

    def of(self, picture: Frame) -> Array:
        """Its part of a picture, float64 [rows, columns, 3]."""
        part: Array = picture[self.top : self.bottom, self.left : self.right].astype(np.float64)
        return part


@dataclass(frozen=True)
class EnteringResult:
    """Somebody who enters a view, in a picture of it.

    Attributes:
        scene_id, episode_id: the scene's own.
        shown: 1.0 where the picture shows that, see `shows`.
    """

    scene_id: str
    episode_id: str
    shown: float


def entering(labelled: LabelledScene, camera: str) -> list[Entering]:
    """Everybody whose box enters a camera's view within half a second, whatever may hide it."""
    spec = CAMERA_SPECS[camera].resized(FRAME_WIDTH)
    x_m, y_m, _, heading = labelled.future[_STEP].astype(np.float64)
    here, there = np.zeros(3), np.array([x_m, y_m, heading])
    found = []
    for agent in labelled.agents:
        poses = np.array([agent.present, agent.future[_STEP]], np.float64)
        if not np.isfinite(poses).all():
            continue
        now, then = _box(agent, poses[0], here, spec), _box(agent, poses[1], there, spec)
        if then is None or (now is not None and _seen_share(now) > _MOST_NOW):
            continue
        left, top, right, bottom = (
            int(np.clip(round(side), 0, most))
            for side, most in zip(then, (FRAME_WIDTH, FRAME_HEIGHT) * 2, strict=True)
        )
        if right - left >= _LEAST_PX and bottom - top >= _LEAST_PX:
            found.append(Entering(camera, agent.agent_id, left, top, right, bottom))
    return found


async def evaluate_entering(
    engine: Engine,
    scenes: Iterable[LabelledScene],
    variant: Variant,
    painters: Mapping[str, Painter],
    *,
    concurrency: int = 16,
) -> dict[str, list[EnteringResult]]:
    """Ask for the picture of every camera that somebody enters, and look for them there and in others.

    Args:
        engine: started.
        scenes: with pictures half a second ahead.
        variant: how pictures are imagined, its row's name among it; one draw of each camera is asked for.
        painters: of other pictures, by the names of their rows.
        concurrency: pictures under way at once.

    Returns:
        A result for everybody whose entering can be told; see `shows`.
    """

    async def work(asked: tuple[LabelledScene, str]) -> list[tuple[str, EnteringResult]]:
        labelled, camera = asked
        who = entering(labelled, camera)
        if not who:
            return []
        came, moved = what_came(labelled, camera), warped(labelled, camera)
        who = [each for each in who if shows(each, came, came, moved)]
        if not who:
            return []
        controls = replace(variant.controls, n=1, camera=camera)
        request = request_for(labelled, replace(variant, next_camera=False, controls=controls))
        request = replace(request, request_id=f"{request.request_id}/{camera}")
        [draw] = await planned(engine, request)
        pictures = {variant.name: engine.paint(request, imagined_codes(draw))}
        pictures |= {name: painter(labelled, camera) for name, painter in painters.items()}
        about = labelled.scene.scene_id, labelled.episode_id
        return [
            (name, EnteringResult(*about, float(bool(shows(each, picture, came, moved)))))
            for name, picture in pictures.items()
            for each in who
        ]

    cameras = ((labelled, camera) for labelled in scenes for camera in cameras_ahead(labelled))
    results: dict[str, list[EnteringResult]] = {}
    for name, result in chain.from_iterable(await over_scenes(cameras, work, concurrency)):
        results.setdefault(name, []).append(result)
    return results


def shows(who: Entering, picture: Frame, came: Frame, moved: Frame) -> bool | None:
    """Whether a picture shows somebody: there it is nearer to what came than to what is seen now, moved.

    None where nothing is to be told, as what came looks there as what is seen now.
    """
    if np.abs(who.of(came) - who.of(moved)).mean() < _LEAST_CHANGE:
        return None
    apart = [float(np.abs(who.of(picture) - who.of(other)).mean()) for other in (came, moved)]
    return apart[0] < apart[1]


def _box(agent: Agent, pose: Array, ego: Array, camera: CameraSpec) -> Array | None:
    """Left, top, right and bottom of an agent's box in pixels, as seen from an ego pose; None behind it."""
    long, wide = agent.length_m / 2, agent.width_m / 2
    corners = np.array([(a, b, c) for a in (long, -long) for b in (wide, -wide) for c in (0, agent.height_m)])
    corners[:, :2] = corners[:, :2] @ _turn(pose[2]).T + pose[:2]
    corners[:, :2] = (corners[:, :2] - ego[:2]) @ _turn(ego[2])
    depth = camera.project(corners)[:, 2]
    if not (depth > _NEAREST_M).any():
        return None
    # What reaches behind the camera is cut off in front of it.
    column, row, _ = camera.project(corners[depth > _NEAREST_M]).T
    return np.array([column.min(), row.min(), column.max(), row.max()])


def _turn(heading: float) -> Array:
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([[cos, -sin], [sin, cos]])


def _seen_share(box: Array) -> float:
    """The share of a box's columns that lie in the picture."""
    left, right = float(box[0]), float(box[2])
    inside = max(0.0, min(right, FRAME_WIDTH) - max(left, 0.0))
    return inside / max(right - left, 1e-9)
