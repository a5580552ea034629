"""A contact sheet: the latest pictures of scenes beside a map of where everyone is and goes."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw

from looktwice.clients.summaries.lettering import font, line_height, wrap
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.metrics import box_corners
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, SEMANTIC_CLASSES, LabelledScene

_PICTURE: Final = (336, 168)
_MAP: Final = 2 * _PICTURE[1]
_GAP: Final = 8
_SHEET_PX: Final = 2100
_HEAD_PX: Final = 15
_TEXT_PX: Final = 13
_BEHIND_M: Final = 12.0
_LEAST_M: Final = 60.0
_SCALE_BAR_M: Final = 20.0
_INK, _PAPER, _LAND = (0, 0, 0), (255, 255, 255), (190, 205, 180)
_ROAD, _LANE, _DRIVEN, _ROUTE = (120, 120, 120), (160, 160, 160), (230, 30, 30), (255, 255, 0)
_KIND_COLOURS: Final = {
    "vehicle": (70, 110, 220),
    "pedestrian": (230, 60, 200),
    "cone": (255, 140, 0),
    "barrier": (200, 80, 0),
}
_CLASS_COLOURS: Final = np.array(
    [(150, 200, 240), (90, 130, 70), (110, 110, 110), (70, 110, 220), (230, 60, 200), (255, 140, 0)], np.uint8
)


def contact_sheet(scenes: Iterable[LabelledScene], path: Path, columns: int | None = None) -> None:
    """Draw ``scenes`` into one PNG, with a legend below.

    Args:
        scenes: what their picture cells show is drawn too, where one of them has it.
        path: where to; nothing is written without scenes.
        columns: of scenes; without them as many as a sheet of 2100 pixels takes.
    """
    shown = list(scenes)
    if not shown:
        return
    dense = any(labelled.dense for labelled in shown)
    width = _PICTURE[0] * (2 if dense else 1) + _MAP
    words = [_words(labelled, width) for labelled in shown]
    height = _MAP + line_height(_HEAD_PX) + max(map(len, words)) * line_height(_TEXT_PX)
    columns = columns or min(len(shown), _SHEET_PX // (width + _GAP))
    rows = -(-len(shown) // columns)
    across, down = width + _GAP, height + _GAP
    legend_px = line_height(_TEXT_PX)
    sheet = Image.new("RGB", (across * columns - _GAP, down * rows + legend_px), _PAPER)
    for number, (labelled, lines) in enumerate(zip(shown, words, strict=True)):
        row, column = divmod(number, columns)
        sheet.paste(_tile(labelled, lines, (width, height), dense=dense), (across * column, down * row))
    _draw_legend(ImageDraw.Draw(sheet), sheet.height - legend_px)
    sheet.save(path)


def _words(labelled: LabelledScene, width_px: int) -> list[str]:
    """The expert's plan, a line or more a track."""
    tracks = (f"{group}: {', '.join(map(str, track))}" for group, track in expert_plan(labelled).tracks())
    return wrap("\n".join(tracks), _TEXT_PX, width_px)


def _tile(
    labelled: LabelledScene, words: Sequence[str], size: tuple[int, int], *, dense: bool
) -> Image.Image:
    tile = Image.new("RGB", size, _PAPER)
    draw = ImageDraw.Draw(tile)
    head = f"{labelled.scene.scene_id}: {', '.join(sorted(labelled.tags)).replace('_', ' ')}"
    draw.text((0, 0), wrap(head.removesuffix(": "), _HEAD_PX, size[0])[0], _INK, font=font(_HEAD_PX))
    top = line_height(_HEAD_PX)
    for row, clip in enumerate(labelled.scene.clips[:2]):
        place = top + row * _PICTURE[1]
        tile.paste(Image.open(io.BytesIO(clip.images[-1])).resize(_PICTURE), (0, place))
        target = next((target for target in labelled.dense if target.camera == clip.camera), None)
        if target is not None:
            painted = Image.fromarray(_CLASS_COLOURS[np.minimum(target.classes, len(SEMANTIC_CLASSES) - 1)])
            tile.paste(painted.resize(_PICTURE, Image.Resampling.NEAREST), (_PICTURE[0], place))
    tile.paste(_bird_eye(labelled), (_PICTURE[0] * (2 if dense else 1), top))
    for row, line in enumerate(words):
        height = top + _MAP + row * line_height(_TEXT_PX)
        draw.text((0, height), line, _INK, font=font(_TEXT_PX))
    return tile


def _draw_legend(draw: ImageDraw.ImageDraw, top: int) -> None:
    left = 0.0
    named = {"driven": _DRIVEN, "history": _PAPER, "route": _ROUTE, **_KIND_COLOURS, "road": _ROAD}
    for name, colour in named.items():
        draw.rectangle((left, top + 2, left + 12, top + 12), fill=colour, outline=_INK)
        draw.text((left + 17, top), name, _INK, font=font(_TEXT_PX))
        left += 35 + font(_TEXT_PX).getlength(name)


def _bird_eye(labelled: LabelledScene) -> Image.Image:
    """From above, the way ahead upwards; far enough for all that was driven and the route."""
    image = Image.new("RGB", (_MAP, _MAP), _LAND)
    draw = ImageDraw.Draw(image)
    ways = [labelled.future[:, :2], *([] if labelled.scene.route is None else [labelled.scene.route])]
    ahead_m, aside_m = np.abs(np.concatenate(ways)).max(axis=0)
    metres = max(_LEAST_M + _BEHIND_M, ahead_m + _BEHIND_M + 3, 2 * aside_m + 6)
    scale = _MAP / metres

    def pixels(points: Any) -> list[tuple[float, float]]:
        return [(_MAP / 2 - scale * float(p[1]), _MAP - scale * (float(p[0]) + _BEHIND_M)) for p in points]

    for number, ring in enumerate(labelled.drivable):
        hole = (
            number > 0
            and _area(ring) < _area(labelled.drivable[0])
            and _is_clockwise(ring) != _is_clockwise(labelled.drivable[0])
        )
        draw.polygon(pixels(ring), fill=_LAND if hole else _ROAD)
    for line in labelled.lane_lines:
        draw.line(pixels(line), fill=_LANE)
    for agent in labelled.agents:
        colour = _KIND_COLOURS[agent.kind]
        track = agent.future[np.isfinite(agent.future[:, 0])]
        if len(track) > 1:
            draw.line(pixels(track), fill=colour)
        if np.isfinite(agent.present[0]):
            draw.polygon(pixels(box_corners(agent.present, agent.length_m, agent.width_m)), fill=colour)
    if labelled.scene.route is not None:
        for x, y in pixels(labelled.scene.route):
            draw.ellipse((x - 2, y - 2, x + 2, y + 2), fill=_ROUTE)
    draw.line(pixels(labelled.scene.history), fill=_PAPER, width=2)
    draw.line(pixels(labelled.future), fill=_DRIVEN, width=2)
    draw.polygon(pixels(box_corners(np.zeros(3), EGO_LENGTH_M, EGO_WIDTH_M)), outline=_DRIVEN)
    bar = scale * _SCALE_BAR_M
    draw.line([(_MAP - 10 - bar, _MAP - 10), (_MAP - 10, _MAP - 10)], fill=_INK, width=2)
    draw.text((_MAP - 10, _MAP - 13), f"{_SCALE_BAR_M:.0f} m", _INK, font=font(_TEXT_PX), anchor="rs")
    return image


def _area(ring: Any) -> float:
    x, y = ring[:, 0], ring[:, 1]
    return abs(float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())) / 2


def _is_clockwise(ring: Any) -> bool:
    x, y = ring[:, 0], ring[:, 1]
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) < 0
