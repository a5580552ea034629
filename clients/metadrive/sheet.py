"""A contact sheet: the latest pictures of scenes beside a map of where everyone is and goes."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw

from model.driving.labeller import expert_plan
from model.driving.metrics import box_corners
from model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, SEMANTIC_CLASSES, LabelledScene

_PICTURE: Final = (336, 168)
_MAP: Final = 340
_METRES: Final = 75.0
_BEHIND: Final = 12.0
_KIND_COLOURS: Final = {
    "vehicle": (70, 110, 220),
    "pedestrian": (230, 60, 200),
    "cone": (255, 140, 0),
    "barrier": (200, 80, 0),
}
_CLASS_COLOURS: Final = np.array(
    [(150, 200, 240), (90, 130, 70), (110, 110, 110), (70, 110, 220), (230, 60, 200), (255, 140, 0)], np.uint8
)


def contact_sheet(scenes: Iterable[LabelledScene], path: Path, columns: int = 2) -> None:
    """Draw ``scenes`` into one PNG."""
    tiles = [_tile(scene) for scene in scenes]
    if not tiles:
        return
    width, height = tiles[0].size
    rows = -(-len(tiles) // columns)
    sheet = Image.new("RGB", (width * columns, height * rows), (255, 255, 255))
    for number, tile in enumerate(tiles):
        sheet.paste(tile, (width * (number % columns), height * (number // columns)))
    sheet.save(path)


def _tile(labelled: LabelledScene) -> Image.Image:
    clips = labelled.scene.clips[:2]
    width = _PICTURE[0] * 2 + _MAP
    tile = Image.new("RGB", (width, _MAP + 46), (255, 255, 255))
    for row, clip in enumerate(clips):
        picture = Image.open(io.BytesIO(clip.images[-1])).resize(_PICTURE)
        tile.paste(picture, (0, row * _PICTURE[1]))
        dense = next((d for d in labelled.dense if d.camera == clip.camera), None)
        if dense is not None:
            painted = Image.fromarray(_CLASS_COLOURS[np.minimum(dense.classes, len(SEMANTIC_CLASSES) - 1)])
            tile.paste(painted.resize(_PICTURE, Image.Resampling.NEAREST), (_PICTURE[0], row * _PICTURE[1]))
    tile.paste(_bird_eye(labelled), (2 * _PICTURE[0], 0))
    draw = ImageDraw.Draw(tile)
    draw.text((4, _MAP + 1), f"{labelled.scene.scene_id}  {' '.join(sorted(labelled.tags))}", (0, 0, 0))
    plan = expert_plan(labelled)
    draw.text((4, _MAP + 13), " ".join(str(plan).split())[:260], (60, 60, 60))
    return tile


def _bird_eye(labelled: LabelledScene) -> Image.Image:
    image = Image.new("RGB", (_MAP, _MAP), (190, 205, 180))
    draw = ImageDraw.Draw(image)
    scale = _MAP / _METRES

    def pixels(points: Any) -> list[tuple[float, float]]:
        return [(_MAP / 2 - scale * float(p[1]), _MAP - scale * (float(p[0]) + _BEHIND)) for p in points]

    for number, ring in enumerate(labelled.drivable):
        hole = (
            number > 0
            and _area(ring) < _area(labelled.drivable[0])
            and _is_clockwise(ring) != _is_clockwise(labelled.drivable[0])
        )
        draw.polygon(pixels(ring), fill=(190, 205, 180) if hole else (120, 120, 120))
    for line in labelled.lane_lines:
        draw.line(pixels(line), fill=(160, 160, 160))
    for agent in labelled.agents:
        colour = _KIND_COLOURS[agent.kind]
        track = agent.future[np.isfinite(agent.future[:, 0])]
        if len(track) > 1:
            draw.line(pixels(track), fill=colour)
        if np.isfinite(agent.present[0]):
            draw.polygon(pixels(box_corners(agent.present, agent.length_m, agent.width_m)), fill=colour)
    if labelled.scene.route is not None:
        for x, y in pixels(labelled.scene.route):
            draw.ellipse((x - 2, y - 2, x + 2, y + 2), fill=(255, 255, 0))
    draw.line(pixels(labelled.scene.history), fill=(255, 255, 255), width=2)
    draw.line(pixels(labelled.future), fill=(230, 30, 30), width=2)
    draw.polygon(pixels(box_corners(np.zeros(3), EGO_LENGTH_M, EGO_WIDTH_M)), outline=(230, 30, 30))
    return image


def _area(ring: Any) -> float:
    x, y = ring[:, 0], ring[:, 1]
    return abs(float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())) / 2


def _is_clockwise(ring: Any) -> bool:
    x, y = ring[:, 0], ring[:, 1]
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) < 0
