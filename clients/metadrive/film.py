"""A film of a drive: what the car sees, what it is about to do, and why."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from clients.metadrive.actors import STEP_S
from clients.metadrive.annotate import to_ego
from clients.metadrive.drive import Shot
from model.driving.cameras import FRONT_CAMERAS, CameraSpec
from model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M
from model.driving.trajectory import FloatArray

_SCALE: Final = 3
_PANEL_PX: Final = 250
_METRES_AHEAD: Final = 60.0
_CHOSEN, _OTHER, _INK, _PAPER = (232, 119, 34), (120, 160, 205), (235, 235, 235), (28, 32, 38)
_KINDS: Final = {
    "vehicle": (150, 60, 60),
    "pedestrian": (240, 200, 60),
    "cone": (240, 140, 40),
    "barrier": (240, 140, 40),
}
_FRAME_MS: Final = 400
_LINE: Final = 62


class Film:
    """Gathers frames; write them with `save`."""

    def __init__(self) -> None:
        self._frames: list[Image.Image] = []
        self._font = ImageFont.load_default(size=14)

    def add(self, shot: Shot) -> None:
        """One moment."""
        spec = FRONT_CAMERAS[0]
        wide = next(picture for picture in shot.pictures if picture.camera == spec.name)
        view = Image.open(io.BytesIO(wide.jpeg)).convert("RGB")
        view = view.resize((spec.width * _SCALE, spec.height * _SCALE), Image.Resampling.BICUBIC)
        draw = ImageDraw.Draw(view)
        if shot.planned is not None:
            for trajectory in shot.planned.others:
                _line_in_view(draw, spec, trajectory, _OTHER, 1)
            _line_in_view(draw, spec, shot.planned.trajectory, _CHOSEN, 3)
        above = _from_above(shot, view.height)
        frame = Image.new("RGB", (view.width + above.width, view.height + _PANEL_PX), _PAPER)
        frame.paste(view, (0, 0))
        frame.paste(above, (view.width, 0))
        self._write(ImageDraw.Draw(frame), shot, view.height + 10)
        self._frames.append(frame)

    def save(self, path: Path) -> None:
        """Write an animated GIF; raises `ValueError` without frames."""
        if not self._frames:
            raise ValueError("a film needs at least one frame")
        first, *others = (frame.quantize(96) for frame in self._frames)
        first.save(path, save_all=True, append_images=others, duration=_FRAME_MS, loop=0, optimize=True)

    def _write(self, draw: ImageDraw.ImageDraw, shot: Shot, top: int) -> None:
        ego = shot.log.ego[shot.step]
        head = f"{shot.driver}    {shot.step * STEP_S:4.1f} s    {ego[3] * 3.6:3.0f} km/h"
        draw.text((12, top), head, fill=_INK, font=self._font)
        if shot.planned is None:
            return
        words = shot.planned.words.replace("- ", "").replace("\n  ", "\n   ")
        draw.multiline_text((12, top + 24), words, fill=_INK, font=self._font, spacing=2)
        told = shot.planned.thinking or "(no second look)"
        draw.multiline_text(
            (300, top + 24), textwrap.fill(told, _LINE), fill=_CHOSEN if shot.planned.thinking else _OTHER,
            font=self._font, spacing=4,
        )  # fmt: skip


def _line_in_view(
    draw: ImageDraw.ImageDraw,
    spec: CameraSpec,
    trajectory: FloatArray,
    colour: tuple[int, int, int],
    width: int,
) -> None:
    """A trajectory on the road, as the camera would see it."""
    ground = np.column_stack([trajectory[:, :2], np.zeros(len(trajectory))])
    column, row, depth = spec.project(ground).T
    seen = depth > 1.0
    points = [(float(x) * _SCALE, float(y) * _SCALE) for x, y in zip(column[seen], row[seen], strict=True)]
    if len(points) > 1:
        draw.line(points, fill=colour, width=width, joint="curve")


def _from_above(shot: Shot, height: int) -> Image.Image:
    """Lanes, others and trajectories from above, the way ahead upwards."""
    scale = height / (_METRES_AHEAD + 15.0)
    image = Image.new("RGB", (int(0.8 * height), height), (52, 58, 66))
    draw = ImageDraw.Draw(image)
    ego = shot.log.ego[shot.step]

    def place(points: Sequence[Sequence[float]] | np.ndarray) -> list[tuple[float, float]]:
        return [(image.width / 2 - y * scale, height - (x + 15.0) * scale) for x, y in points]

    for lane in shot.log.road_map.lanes:
        near = to_ego(lane.centre, ego)
        if np.hypot(*near.T).min() < 100.0:
            edge = to_ego(np.asarray(lane.polygon.exterior.coords), ego)
            draw.polygon(place(edge), fill=(84, 88, 94), outline=(120, 124, 130))
    for actor in shot.log.actors:
        pose = actor.poses[shot.step]
        if np.isfinite(pose[0]):
            box = _box(to_ego(pose[:2], ego), float(pose[2] - ego[2]), actor.size[0], actor.size[1])
            draw.polygon(place(box), fill=_KINDS[actor.kind])
    if shot.planned is not None:
        for trajectory in shot.planned.others:
            draw.line(place(trajectory[:, :2]), fill=_OTHER, width=1)
        draw.line(place(shot.planned.trajectory[:, :2]), fill=_CHOSEN, width=3)
    draw.polygon(place(_box(np.zeros(2), 0.0, EGO_LENGTH_M, EGO_WIDTH_M)), fill=_INK)
    return image


def _box(centre: np.ndarray, heading: float, length_m: float, width_m: float) -> np.ndarray:
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length_m / 2, width_m / 2]
    cos, sin = np.cos(heading), np.sin(heading)
    turned: np.ndarray = corners @ np.array([[cos, sin], [-sin, cos]]) + centre
    return turned
