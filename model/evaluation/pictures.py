"""Pictures of plans: what the cameras saw, what was said, where it leads."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from looktwice.model.driving.images import decode_image
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.metrics import common, displacement_errors
from looktwice.model.driving.plan import Plan
from looktwice.model.driving.scene import CLIP_FRAMES, CLIP_PERIOD_S, Clip, LabelledScene, Scene
from looktwice.model.driving.trajectory import present_speed
from looktwice.model.engines.engine import Draw
from looktwice.model.evaluation.birds_eye import DIRECT_COLOUR, REFLECTED_COLOUR, draw_birds_eye
from looktwice.model.evaluation.open_loop import iou_with_expert
from looktwice.model.evaluation.timeline import draw_timeline, row_count

WIDTH_PX: Final = 1400
HEIGHT_PX: Final = 900
_DPI: Final = 100
_MARGIN: Final = 22
_GAP: Final = 10
_LEFT_WIDTH: Final = 850
_TITLE_HEIGHT: Final = 62
_ROW_HEIGHT: Final = 64
_INK: Final = "#1c242c"
_GREY: Final = "#5b6670"


def plan_picture(
    scene: Scene | LabelledScene, draws: Sequence[Draw], path: Path | IO[bytes], *, shown: int = 0
) -> None:
    """Write a PNG of 1400x900 pixels: cameras, timeline of the plans, bird's-eye view.

    Args:
        scene: with labels, the expert, the road and the agents are drawn too.
        draws: all trajectories are drawn.
        path: where to.
        shown: which of the draws' plans are told.

    Raises:
        ImageError: a picture of the scene that cannot be decoded.
        IndexError: ``shown`` is none of the draws.
    """
    labelled = scene if isinstance(scene, LabelledScene) else None
    seen = scene.scene if isinstance(scene, LabelledScene) else scene
    chosen = draws[shown] if draws else None
    figure = Figure((WIDTH_PX / _DPI, HEIGHT_PX / _DPI), dpi=_DPI, facecolor="white")
    _draw_title(figure, seen, labelled, draws, chosen)
    top = _draw_cameras(figure, seen.clips, _MARGIN + _TITLE_HEIGHT)
    top = _draw_thinking(figure, chosen, top)
    _draw_plans(figure, labelled, chosen, top)
    left = _MARGIN + _LEFT_WIDTH + 2 * _GAP
    birds_eye = _axes(
        figure,
        left,
        _MARGIN + _TITLE_HEIGHT,
        WIDTH_PX - left - _MARGIN,
        HEIGHT_PX - 2 * _MARGIN - _TITLE_HEIGHT,
    )
    draw_birds_eye(birds_eye, seen, labelled, draws, shown)
    figure.savefig(path, format="png")


def _axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Axes at a place in pixels, counted from the upper left corner."""
    return figure.add_axes(
        (left / WIDTH_PX, 1 - (top + height) / HEIGHT_PX, width / WIDTH_PX, height / HEIGHT_PX)
    )


def _text(figure: Figure, left: float, top: float, text: str, **style: Any) -> None:
    # Names and reflections are not ours: a dollar sign in them is no formula.
    figure.text(left / WIDTH_PX, 1 - top / HEIGHT_PX, text, va="top", parse_math=False, **style)


def _draw_title(
    figure: Figure, scene: Scene, labelled: LabelledScene | None, draws: Sequence[Draw], chosen: Draw | None
) -> None:
    speed = present_speed(scene.history)
    facts = [f"{speed:.1f} m/s ({3.6 * speed:.0f} km/h)"]
    if labelled is not None and labelled.tags:
        facts.append(", ".join(tag.replace("_", " ") for tag in sorted(labelled.tags)))
    if draws:
        facts.append("1 draw" if len(draws) == 1 else f"{len(draws)} draws")
    if labelled is not None and draws:
        trajectories = np.stack([draw.trajectory for draw in draws])
        errors = displacement_errors(*common(trajectories, labelled.future, draws[0].times_s))
        facts.append(f"minADE {errors.min_ade_m:.2f} m")
    headline, colour = "Planned without a plan in words", DIRECT_COLOUR
    if chosen is None:
        headline, colour = "Nothing planned yet", _GREY
    elif chosen.looked_twice:
        headline, colour = "Looked twice", REFLECTED_COLOUR
    elif chosen.branch is not None:
        headline = "Acted directly"
    if chosen is not None and chosen.think_probability is not None:
        headline += f"  ·  think probability {chosen.think_probability:.2f}"
    _text(figure, _MARGIN, 16, headline, fontsize=17, weight="bold", color=colour)
    _text(
        figure, _MARGIN, 46, f"scene {scene.scene_id}  ·  " + "  ·  ".join(facts), fontsize=10.5, color=_GREY
    )


def _draw_cameras(figure: Figure, clips: Sequence[Clip], top: float) -> float:
    """Draw two clips with their older frames, more as their latest ones alone; return the lower edge."""
    with_older = len(clips) <= 2
    columns = min(len(clips), 2 if with_older else 3)
    width = (_LEFT_WIDTH - (columns - 1) * _GAP) / (columns if columns > 1 else 2)
    bottom = top
    for index, clip in enumerate(clips):
        left = _MARGIN + index % columns * (width + _GAP)
        if index % columns == 0:
            top = bottom
        lower = _draw_frame(figure, clip.images[-1], left, top, width, clip.camera, fontsize=9)
        if with_older:
            small = (width - (CLIP_FRAMES - 2) * 6) / (CLIP_FRAMES - 1)
            upper = lower + 6
            for place, image in enumerate(clip.images[:-1]):
                age_s = (place - CLIP_FRAMES + 1) * CLIP_PERIOD_S
                at = left + place * (small + 6)
                lower = _draw_frame(figure, image, at, upper, small, f"{age_s:+.1f} s", fontsize=7.5)
        bottom = max(bottom, lower + _GAP)
    return bottom


def _draw_frame(
    figure: Figure, image: bytes, left: float, top: float, width: float, label: str, *, fontsize: float
) -> float:
    pixels = decode_image(image)
    rows, columns, _ = pixels.shape
    height = width * min(rows / columns, 0.62)
    axes = _axes(figure, left, top, width, height)
    axes.imshow(pixels, interpolation="bicubic")
    axes.set_axis_off()
    axes.text(
        0.015,
        0.965,
        label,
        transform=axes.transAxes,
        va="top",
        fontsize=fontsize,
        color="white",
        bbox={"facecolor": "#111820", "alpha": 0.6, "edgecolor": "none", "pad": 2},
    )
    return float(top + height)


def _draw_thinking(figure: Figure, chosen: Draw | None, top: float) -> float:
    """Write the reflection below the cameras; return the lower edge."""
    if chosen is None or not chosen.thinking:
        return top
    lines = textwrap.wrap(" ".join(chosen.thinking.split()), width=114, max_lines=4, placeholder=" …")
    axes = _axes(figure, _MARGIN, top + 4, 4, 18 * len(lines))
    axes.set_facecolor(REFLECTED_COLOUR)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
    for number, line in enumerate(lines):
        _text(figure, _MARGIN + 14, top + 5 + 18 * number, line, fontsize=10, color=_INK, style="italic")
    return top + 18 * len(lines) + 2 * _GAP


def _draw_plans(figure: Figure, labelled: LabelledScene | None, chosen: Draw | None, top: float) -> None:
    expert = None if labelled is None else expert_plan(labelled)

    def named(name: str, plan: Plan) -> tuple[str, Plan]:
        return (name if expert is None else f"{name}\nIOU {iou_with_expert(plan, expert):.2f}", plan)

    plans = []
    if chosen is not None and chosen.plan is not None:
        plans.append(named("plan" if chosen.revised_plan is None else "first plan", chosen.plan))
    if chosen is not None and chosen.revised_plan is not None:
        plans.append(named("revised", chosen.revised_plan))
    if expert is not None:
        plans.append(("expert", expert))
    if not plans:
        return
    labels_width = 138
    room = HEIGHT_PX - _MARGIN - 24 - top
    height = min(room, _ROW_HEIGHT * row_count(plans))
    draw_timeline(_axes(figure, _MARGIN + labels_width, top + 4, _LEFT_WIDTH - labels_width, height), plans)
