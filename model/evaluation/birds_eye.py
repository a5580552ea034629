"""A labelled scene and its draws seen from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch, Polygon
from matplotlib.path import Path as Outline

from looktwice.model.driving.metrics import box_corners, points_inside
from looktwice.model.driving.scene import EGO_LENGTH_M, EGO_WIDTH_M, Agent, AgentKind, LabelledScene, Scene
from looktwice.model.driving.trajectory import FloatArray
from looktwice.model.engines.engine import Draw

DIRECT_COLOUR: Final = "#1f6fd0"
REFLECTED_COLOUR: Final = "#d9480f"
EXPERT_COLOUR: Final = "#14924c"
_ROUTE_COLOUR: Final = "#7048b6"
_GRASS: Final = "#e8ede3"
_ROAD: Final = "#cdd3d9"
_AGENT_COLOURS: Final[Mapping[AgentKind, str]] = {
    "vehicle": "#46586b",
    "pedestrian": "#c2255c",
    "cone": "#f08c00",
    "barrier": "#a8651b",
}

_BEHIND_M: Final = 12.0
_MIN_AHEAD_M: Final = 38.0
_MARGIN_M: Final = 8.0
_SECOND: Final = 10
"""Rows of a trajectory in one second: where its dots are."""

Array = npt.NDArray[np.float64]


def draw_birds_eye(
    axes: Axes, scene: Scene, labelled: LabelledScene | None, draws: Sequence[Draw], shown: int
) -> None:
    """Draw road, agents, route, expert and draws; x (forward) is up, y (left) is to the left, metres.

    Args:
        axes: fills them; their shape decides how much of the scene is seen.
        scene: whose route is drawn.
        labelled: its labels, if there are any.
        draws: what was planned.
        shown: the draw that is drawn boldly.
    """
    axes.set_facecolor(_GRASS if labelled is not None and labelled.drivable else "white")
    if labelled is not None:
        _draw_road(axes, labelled)
    if scene.route is not None:
        route = _up(scene.route)
        axes.scatter(route[:, 0], route[:, 1], s=9, color=_ROUTE_COLOUR, alpha=0.7, linewidths=0, zorder=3)
    for agent in labelled.agents if labelled is not None else ():
        _draw_agent(axes, agent)
    if labelled is not None:
        axes.plot(
            *_up(_from_origin(labelled.future)).T, color=EXPERT_COLOUR, linewidth=5, alpha=0.55, zorder=5
        )
    for index, draw in enumerate(draws):
        if index != shown:
            _draw_trajectory(axes, draw, bold=False)
    if draws:
        _draw_trajectory(axes, draws[shown], bold=True)
    _draw_ego(axes)
    _set_view(axes, scene, labelled, draws)
    _draw_legend(axes, scene, labelled, draws)


def _up(points: npt.NDArray[np.floating]) -> Array:
    """Ego-frame points [..., >= 2] (x forward, y left) as plot coordinates (right, up)."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1).astype(np.float64)


def _from_origin(trajectory: FloatArray) -> Array:
    return np.concatenate([np.zeros((1, 2)), trajectory[:, :2]])


def _draw_road(axes: Axes, labelled: LabelledScene) -> None:
    rings = labelled.drivable
    vertices, codes = [], []
    for index, ring in enumerate(rings):
        # Outlines are filled by winding: an outer ring must turn one way and a hole the other.
        others = [*rings[:index], *rings[index + 1 :]]
        is_hole = bool(points_inside(ring[:1], others)[0])
        clockwise = (
            float(np.sum(ring[:, 0] * np.roll(ring[:, 1], -1) - np.roll(ring[:, 0], -1) * ring[:, 1])) < 0
        )
        corners = _up(ring if clockwise == is_hole else ring[::-1])
        vertices.append(np.concatenate([corners, corners[:1]]))
        codes.append([Outline.MOVETO, *[Outline.LINETO] * (len(corners) - 1), Outline.CLOSEPOLY])
    if vertices:
        outline = Outline(np.concatenate(vertices), np.concatenate(codes))
        axes.add_patch(PathPatch(outline, facecolor=_ROAD, edgecolor="#a9b2bb", linewidth=0.8, zorder=1))
    lines = [_up(line) for line in labelled.lane_lines]
    axes.add_collection(LineCollection(lines, colors="#e4e8ec", linewidths=1.0, zorder=2))


def _draw_agent(axes: Axes, agent: Agent) -> None:
    colour = _AGENT_COLOURS[agent.kind]
    future = agent.future[np.isfinite(agent.future[:, 0])]
    moves = len(future) > 1 and float(np.ptp(future[:, :2], axis=0).max()) > 1.0
    if moves:
        points = _up(future)
        pieces = np.stack([points[:-1], points[1:]], axis=1)
        fading = [to_rgba(colour, 0.6 - 0.5 * i / len(pieces)) for i in range(len(pieces))]
        axes.add_collection(LineCollection(list(pieces), colors=fading, linewidths=1.6, zorder=3))
        later = future[2 * _SECOND - 1 :: 2 * _SECOND]
        boxes = [Polygon(_up(box)) for box in box_corners(later, agent.length_m, agent.width_m)]
        ghosts = [to_rgba(colour, 0.30 - 0.08 * i) for i in range(len(boxes))]
        axes.add_collection(
            PatchCollection(
                boxes, facecolors=ghosts, edgecolors=to_rgba(colour, 0.35), linewidths=0.6, zorder=3
            )
        )
    if np.isfinite(agent.present).all():
        corners = _up(box_corners(agent.present, agent.length_m, agent.width_m))
        axes.add_patch(Polygon(corners, facecolor=colour, edgecolor="white", linewidth=0.8, zorder=6))
        if agent.kind == "vehicle":
            nose = np.array([corners[0], corners[1], corners.mean(axis=0)])
            axes.add_patch(Polygon(nose, facecolor="white", alpha=0.55, linewidth=0, zorder=6))


def _draw_trajectory(axes: Axes, draw: Draw, *, bold: bool) -> None:
    colour = REFLECTED_COLOUR if draw.looked_twice else DIRECT_COLOUR
    points = _up(_from_origin(draw.at_10_hz))
    axes.plot(
        *points.T,
        color=colour,
        linewidth=2.6 if bold else 1.3,
        alpha=1.0 if bold else 0.55,
        solid_capstyle="round",
        zorder=8 if bold else 7,
    )
    if bold:
        dots = points[_SECOND::_SECOND]
        axes.scatter(
            dots[:, 0], dots[:, 1], s=24, facecolor="white", edgecolor=colour, linewidth=1.4, zorder=9
        )


def _draw_ego(axes: Axes) -> None:
    corners = _up(box_corners(np.zeros(3), EGO_LENGTH_M, EGO_WIDTH_M))
    axes.add_patch(Polygon(corners, facecolor="#111820", edgecolor="white", linewidth=1.2, zorder=10))
    nose = np.array([corners[0], corners[1], corners.mean(axis=0)])
    axes.add_patch(Polygon(nose, facecolor="#ffd43b", linewidth=0, zorder=11))


def _set_view(axes: Axes, scene: Scene, labelled: LabelledScene | None, draws: Sequence[Draw]) -> None:
    """Show every trajectory with a margin, at one scale for both directions, in axes of the given shape."""
    paths = [draw.trajectory[:, :2] for draw in draws]
    if labelled is not None:
        paths.append(labelled.future[:, :2])
    points = _up(np.concatenate([np.zeros((1, 2)), *paths]))
    left, right = points[:, 0].min() - _MARGIN_M, points[:, 0].max() + _MARGIN_M
    low = min(-_BEHIND_M, points[:, 1].min() - _MARGIN_M)
    high = max(_MIN_AHEAD_M, points[:, 1].max() + _MARGIN_M)
    box = axes.get_window_extent()
    shape = box.height / box.width
    if (high - low) / (right - left) > shape:
        middle, half = (left + right) / 2, (high - low) / shape / 2
        left, right = middle - half, middle + half
    else:
        high = low + (right - left) * shape
    axes.set_xlim(left, right)
    axes.set_ylim(low, high)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#9aa5b0")
    _draw_scale(axes, left, right, low, high)


def _draw_scale(axes: Axes, left: float, right: float, low: float, high: float) -> None:
    x, y = right - 0.06 * (right - left), low + 0.03 * (high - low)
    axes.plot([x - 10, x], [y, y], color="#2b333b", linewidth=2, zorder=12, solid_capstyle="butt")
    axes.text(x - 5, y + 0.008 * (high - low), "10 m", ha="center", va="bottom", fontsize=8, zorder=12)


def _draw_legend(axes: Axes, scene: Scene, labelled: LabelledScene | None, draws: Sequence[Draw]) -> None:
    handles = []
    if any(not draw.looked_twice for draw in draws):
        handles.append(Line2D([], [], color=DIRECT_COLOUR, linewidth=2, label="direct"))
    if any(draw.looked_twice for draw in draws):
        handles.append(Line2D([], [], color=REFLECTED_COLOUR, linewidth=2, label="second look"))
    if labelled is not None:
        handles.append(Line2D([], [], color=EXPERT_COLOUR, linewidth=5, alpha=0.55, label="expert"))
    if scene.route is not None:
        handles.append(
            Line2D([], [], color=_ROUTE_COLOUR, marker="o", markersize=3, linestyle="none", label="route")
        )
    if handles:
        # Above the view: inside, it would hide where somebody goes.
        axes.legend(
            handles=handles,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(handles),
            fontsize=9,
            frameon=False,
            borderaxespad=0.2,
            columnspacing=1.4,
            handlelength=1.6,
        )
