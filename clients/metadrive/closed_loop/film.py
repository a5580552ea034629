"""A film of a drive: what the car sees, what it is about to do, and why."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw

from looktwice.clients.metadrive.closed_loop.drives import Shot
from looktwice.clients.metadrive.scenes.annotate import to_ego
from looktwice.clients.metadrive.scenes.windows import PICTURE_STEPS
from looktwice.clients.metadrive.world.actors import STEP_S
from looktwice.clients.summaries.lettering import Colour, write_in_box
from looktwice.model.driving.cameras import FRONT_CAMERAS, CameraSpec
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, FRONT_WIDE
from looktwice.model.driving.trajectory import FloatArray

_CAMERA_PX: Final = 560
_ABOVE_PX: Final = 300
_TEXT_PX: Final = 330
_MARGIN_PX: Final = 14
_LETTERS_PX: Final = 15
_METRES_AHEAD: Final = 60.0
_METRES_BEHIND: Final = 15.0
_CHOSEN: Final = (232, 119, 34)
_OTHER: Final = (120, 160, 205)
_INK: Final = (235, 235, 235)
_PAPER: Final = (28, 32, 38)
_KINDS: Final = {
    "vehicle": (150, 60, 60),
    "pedestrian": (240, 200, 60),
    "cone": (240, 140, 40),
    "barrier": (240, 140, 40),
}
IMAGINED: Final = FRONT_WIDE
"""The camera of imagined pictures."""
_FRAME_MS: Final = 400
_COLOURS: Final = 255


class Film:
    """Gathers frames; write them with `save`.

    A frame shows both cameras, beside them the road from above and the plan in words.

    Args:
        imagines: below that, what `IMAGINED` sees, beside what the driver imagined of it half a second ago.
    """

    def __init__(self, *, imagines: bool = False) -> None:
        self._frames: list[Image.Image] = []
        self._imagines = imagines
        self._imagined: dict[int, bytes] = {}
        """Pictures by the step that they are of."""

    def add(self, shot: Shot) -> None:
        """One moment."""
        views = [_view(shot, spec.resized(_CAMERA_PX)) for spec in FRONT_CAMERAS]
        height = sum(view.height for view in views)
        frame = Image.new("RGB", (_CAMERA_PX + _ABOVE_PX + _TEXT_PX, height), _PAPER)
        for row, view in enumerate(views):
            frame.paste(view, (0, row * view.height))
        frame.paste(_from_above(shot, _ABOVE_PX, height), (_CAMERA_PX, 0))
        left = _CAMERA_PX + _ABOVE_PX + _MARGIN_PX
        box = (left, _MARGIN_PX, frame.width - _MARGIN_PX, height - _MARGIN_PX)
        write_in_box(ImageDraw.Draw(frame), box, _words(shot), _LETTERS_PX)
        if self._imagines:
            frame = self._with_imagined(shot, frame)
        self._frames.append(frame)

    def _with_imagined(self, shot: Shot, frame: Image.Image) -> Image.Image:
        """A frame with a strip below: what came, and what was imagined; dark where nothing was."""
        taken = next(picture for picture in shot.pictures if picture.camera == IMAGINED)
        strip = [("what came", taken.jpeg), ("imagined half a second ago", self._imagined.get(shot.step))]
        if shot.planned is not None and shot.planned.imagined is not None:
            self._imagined = {shot.step + PICTURE_STEPS: shot.planned.imagined}
        width = frame.width // 2
        height = width // 2
        whole = Image.new("RGB", (frame.width, frame.height + height), _PAPER)
        whole.paste(frame)
        draw = ImageDraw.Draw(whole)
        for place, (title, picture) in enumerate(strip):
            left, top = place * width, frame.height
            if picture is not None:
                view = Image.open(io.BytesIO(picture)).convert("RGB")
                whole.paste(view.resize((width, height), Image.Resampling.BICUBIC), (left, top))
            box = (left + _MARGIN_PX, top + _MARGIN_PX, left + width - _MARGIN_PX, top + height)
            write_in_box(draw, box, [(title, _INK)], _LETTERS_PX)
        return whole

    def save(self, path: Path) -> None:
        """Write an animated GIF; raises `ValueError` without frames."""
        if not self._frames:
            raise ValueError("a film needs at least one frame")
        first, *others = (frame.quantize(_COLOURS) for frame in self._frames)
        first.save(path, save_all=True, append_images=others, duration=_FRAME_MS, loop=0, optimize=True)


def _words(shot: Shot) -> list[tuple[str, Colour]]:
    """The paragraphs beside the pictures, with their colours."""
    ego = shot.log.ego[shot.step]
    told = [(f"{shot.driver} · {shot.step * STEP_S:.1f} s · {ego[3] * 3.6:.0f} km/h", _INK), ("", _INK)]
    if shot.planned is None:
        return told
    plan = shot.planned.words.replace("  - ", "    ").replace("- ", "").rstrip()
    thinking = shot.planned.thinking
    look = (f"Second look: {thinking}", _CHOSEN) if thinking else ("No second look.", _OTHER)
    return [*told, (plan, _INK), ("", _INK), look]


def _view(shot: Shot, spec: CameraSpec) -> Image.Image:
    """A camera's picture with the trajectories on the road."""
    taken = next(picture for picture in shot.pictures if picture.camera == spec.name)
    view = Image.open(io.BytesIO(taken.jpeg)).convert("RGB")
    view = view.resize((spec.width, spec.height), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(view)
    if shot.planned is not None:
        for trajectory in shot.planned.others:
            _line_in_view(draw, spec, trajectory, _OTHER, 1)
        _line_in_view(draw, spec, shot.planned.trajectory, _CHOSEN, 3)
    return view


def _line_in_view(
    draw: ImageDraw.ImageDraw,
    spec: CameraSpec,
    trajectory: FloatArray,
    colour: Colour,
    width: int,
) -> None:
    """A trajectory on the road, as the camera would see it."""
    ground = np.column_stack([trajectory[:, :2], np.zeros(len(trajectory))])
    column, row, depth = spec.project(ground).T
    seen = depth > 1.0
    points = [(float(x), float(y)) for x, y in zip(column[seen], row[seen], strict=True)]
    if len(points) > 1:
        draw.line(points, fill=colour, width=width, joint="curve")


def _from_above(shot: Shot, width: int, height: int) -> Image.Image:
    """Lanes, others and trajectories from above, the way ahead upwards."""
    scale = height / (_METRES_AHEAD + _METRES_BEHIND)
    image = Image.new("RGB", (width, height), (52, 58, 66))
    draw = ImageDraw.Draw(image)
    ego = shot.log.ego[shot.step]

    def place(points: Sequence[Sequence[float]] | np.ndarray) -> list[tuple[float, float]]:
        return [(image.width / 2 - y * scale, height - (x + _METRES_BEHIND) * scale) for x, y in points]

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
