"""The open-loop protocols of ST-P3 and UniAD side by side, with the quirks that their figures come with.

Both compare six waypoints, half a second apart, with the expert's. They name their figures alike and measure
different things, so a table must say which it holds (VLA-World, appendix B.2):

====================  =================================  ========================================
                      ST-P3 (and VAD)                    UniAD
====================  =================================  ========================================
a figure at t         mean over all waypoints up to t    the waypoint at t alone
objects               vehicles and pedestrians           vehicles
lateral rounding      to the right, up to a cell         to the left, up to a cell
====================  =================================  ========================================

The last row comes from how each turns the grid of the occupied cells: ST-P3 flips it and negates what is to
the right, UniAD negates twice. Both then cut decimals off.

Quirks that both share, and that are kept here:

* Cells are half a metre wide, and boxes are drawn with corners rounded to cells, edges included: an object is
  up to a cell larger than it is.
* The ego's box is 4.084 m x 1.85 m, half a metre ahead of the waypoint, and never turns.
* A waypoint where the expert's own box is hit counts as one without a collision; it stays in the mean.
* Every waypoint counts alone: who went through a car at 1.5 s has no collision at 2 s.
* What leaves the grid is moved to its border.
* Cones and barriers are no objects.

Waypoints and experts are float [n, 6, 2] in our ego frame (ahead, left). Sources: the public evaluation code
of UniAD and VAD, and that of Agent-Driver, which holds both and which later papers share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from looktwice.model.driving.agents import Agent, AgentKind
from looktwice.model.driving.metrics import box_corners
from looktwice.model.driving.paper_axes import to_paper_axes
from looktwice.model.driving.trajectory import STEP_S, THREE_SECONDS_S

Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

Protocol = Literal["ST-P3", "UniAD"]
WAYPOINT_TIMES_S: Final = THREE_SECONDS_S
TOLD_AT_S: Final = (1.0, 2.0, 3.0)
"""Where the protocols tell their figures."""
_TOLD: Final = tuple(WAYPOINT_TIMES_S.index(time_s) for time_s in TOLD_AT_S)
_ROWS: Final = [round(time_s / STEP_S) - 1 for time_s in WAYPOINT_TIMES_S]

CELL_M: Final = 0.5
REACH_M: Final = 50.0
CELLS: Final = 200
"""Cells along each side of the grid."""
EGO_LENGTH_M: Final = 4.084
EGO_WIDTH_M: Final = 1.85
EGO_SHIFT_M: Final = 0.5
"""How far the ego's box lies ahead of its waypoint."""
OBJECTS: Final[dict[Protocol, frozenset[AgentKind]]] = {
    "ST-P3": frozenset({"vehicle", "pedestrian"}),
    "UniAD": frozenset({"vehicle"}),
}


class ProtocolError(ValueError):
    """Arrays that a protocol cannot measure; the text says why."""


@dataclass(frozen=True)
class ProtocolFigures:
    """What one protocol tells of n scenes.

    Attributes:
        protocol: whose.
        l2_m: at 1, 2 and 3 s.
        collision_rate: at 1, 2 and 3 s, 0 to 1.
    """

    protocol: Protocol
    l2_m: tuple[float, float, float]
    collision_rate: tuple[float, float, float]

    @property
    def average_l2_m(self) -> float:
        """The mean of the three."""
        return float(np.mean(self.l2_m))

    @property
    def average_collision_rate(self) -> float:
        """The mean of the three."""
        return float(np.mean(self.collision_rate))


def st_p3(waypoints: Array, experts: Array, occupied: BoolArray) -> ProtocolFigures:
    """ST-P3's figures: each the mean over all waypoints up to its time.

    Args:
        waypoints, experts: float [n, 6, 2], ego frame.
        occupied: bool [n, 6, 200, 200], see `occupied_cells`.

    Raises:
        ProtocolError: shapes that do not fit, numbers that are not finite, or no scenes.
    """
    return _figures("ST-P3", waypoints, experts, occupied, lambda values, last: values[: last + 1].mean())


def uniad(waypoints: Array, experts: Array, occupied: BoolArray) -> ProtocolFigures:
    """UniAD's figures: each that of the waypoint at its time. Arguments and errors are those of `st_p3`."""
    return _figures("UniAD", waypoints, experts, occupied, lambda values, last: values[last])


def collisions(protocol: Protocol, waypoints: Array, experts: Array, occupied: BoolArray) -> BoolArray:
    """Which waypoints [n, 6] count as collisions; none does where the expert's own box is hit."""
    _check(waypoints, experts, occupied)
    hit = _hits(protocol, waypoints, occupied)
    return hit & ~_hits(protocol, experts, occupied)


def occupied_cells(protocol: Protocol, agents: Sequence[Agent]) -> BoolArray:
    """Cells bool [6, 200, 200] that a protocol's objects cover at the waypoints' times.

    Rows go ahead and columns to the right, both from -50 m on.
    """
    cells = np.zeros((len(WAYPOINT_TIMES_S), CELLS, CELLS), np.bool_)
    counted = [agent for agent in agents if agent.kind in OBJECTS[protocol]]
    for grid, row in zip(cells, _ROWS, strict=True):
        canvas = Image.new("1", (CELLS, CELLS))
        for agent in counted:
            pose = agent.future[row]
            if np.isfinite(pose).all():
                corners = to_paper_axes(box_corners(pose, agent.length_m, agent.width_m))
                places = np.round((corners + REACH_M) / CELL_M).astype(int)
                ImageDraw.Draw(canvas).polygon([(int(x), int(y)) for x, y in places], fill=1, outline=1)
        grid |= np.asarray(canvas, np.bool_)
    return cells


def _figures(
    protocol: Protocol,
    waypoints: Array,
    experts: Array,
    occupied: BoolArray,
    told: Callable[[Array, int], float],
) -> ProtocolFigures:
    hit = collisions(protocol, waypoints, experts, occupied).mean(axis=0)
    apart_m = np.linalg.norm(waypoints - experts, axis=-1).mean(axis=0)
    l2_m, rate = (
        (float(told(values, _TOLD[0])), float(told(values, _TOLD[1])), float(told(values, _TOLD[2])))
        for values in (apart_m, hit)
    )
    return ProtocolFigures(protocol, l2_m, rate)


def _hits(protocol: Protocol, waypoints: Array, occupied: BoolArray) -> BoolArray:
    """Whether the ego's box covers an occupied cell at each waypoint [n, 6]."""
    right_m, ahead_m = np.moveaxis(to_paper_axes(waypoints), -1, 0)
    flipped = protocol == "ST-P3"
    if flipped:
        right_m, occupied = -right_m, occupied[..., ::-1]
    rows, columns = _ego_cells()
    scene, time = np.indices(waypoints.shape[:2])[..., None]
    row = _in_grid(ahead_m[..., None] / CELL_M + rows)
    column = _in_grid(right_m[..., None] / CELL_M + columns)
    hit: BoolArray = occupied[scene, time, row, column].any(axis=-1)
    return hit


def _in_grid(places: Array) -> npt.NDArray[np.int64]:
    """Whole cells of places along a side: decimals are cut off, and what is outside moves to the border."""
    return np.clip(places.astype(np.int64), 0, CELLS - 1)


@cache
def _ego_cells() -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows and columns [32] of the cells whose centres lie in the box of an ego at the origin."""
    centre_m = (np.arange(CELLS) + 0.5) * CELL_M - REACH_M
    rows = np.flatnonzero(np.abs(centre_m - EGO_SHIFT_M) <= EGO_LENGTH_M / 2)
    columns = np.flatnonzero(np.abs(centre_m) <= EGO_WIDTH_M / 2)
    grid = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    return grid[:, 0], grid[:, 1]


def _check(waypoints: Array, experts: Array, occupied: BoolArray) -> None:
    count = len(waypoints)
    if not count:
        raise ProtocolError("there are no scenes to measure")
    for name, array, shape in (
        ("waypoints", waypoints, (count, len(WAYPOINT_TIMES_S), 2)),
        ("experts", experts, (count, len(WAYPOINT_TIMES_S), 2)),
        ("occupied", occupied, (count, len(WAYPOINT_TIMES_S), CELLS, CELLS)),
    ):
        if array.shape != shape:
            raise ProtocolError(f"{name} must have shape {list(shape)}, got {list(array.shape)}")
        if not np.isfinite(array).all():
            raise ProtocolError(f"{name} holds values that are not finite")
