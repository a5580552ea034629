"""Lanes as a graph: which lane leads to which, and which of them somebody drives along."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.route_frame import RouteFrame
from looktwice.model.driving.trajectory import FloatArray, wrap_angle

Array = npt.NDArray[np.float64]

_TOUCH_M: Final = 1.0
"""One lane leads to another where its end is this near to the other's beginning; maps of lanes are exact to
centimetres, but their lines have a point every few metres only."""
_SAME_WAY_RAD: Final = float(np.deg2rad(30))
"""Lanes that lead to each other, and who drives along a lane, head the same way but for this."""
_ON_LANE_M: Final = 3.0
"""Who is farther from all centre lines is on no lane: lanes are 3.5 m wide, and experts cut corners."""
_AS_NEAR_M: Final = 0.5
"""Lanes that begin at one place lie as near as each other up to this: where they lead decides then."""
_BEYOND_M: Final = 40.0
"""Ways are followed so far beyond the path."""
_MOST_LANES: Final = 12
"""Of one way: roundabouts have no end."""
_APART_M: Final = 0.05


@dataclass(frozen=True, eq=False)
class LanePath:
    """Lanes one after the other.

    Attributes:
        lanes: their places among the graph's lines.
        line: float64 [k, 2], their centre lines as one.
        at_fork: whether one that the path reaches is one of several that its predecessor leads to.
    """

    lanes: tuple[int, ...]
    line: Array
    at_fork: bool

    @cached_property
    def frame(self) -> RouteFrame:
        """Metres along the way from the ego, and to its left."""
        return RouteFrame(self.line.astype(np.float32))

    @cached_property
    def ahead(self) -> Array:
        """float64 [k, 2]: the line from beside the ego onwards."""
        nearest = int(np.linalg.norm(self.line, axis=1).argmin())
        return self.line[min(nearest, len(self.line) - 2) :]


class LaneGraph:
    """The lanes around the ego, and which leads to which.

    Args:
        lane_lines: centre lines in the direction of traffic, float32 [k, 2] each, in the ego frame.
    """

    def __init__(self, lane_lines: Sequence[FloatArray]) -> None:
        lines = (_joined([line.astype(np.float64)]) for line in lane_lines)
        self.lines = tuple(line for line in lines if len(line) > 1)
        self._follows = _follows(self.lines)

    def follows(self, lane: int) -> tuple[int, ...]:
        """The lanes that a lane leads to."""
        return self._follows[lane]

    def lanes_at(self, point: Array, heading_rad: float) -> tuple[int, ...]:
        """The lanes that somebody at ``point`` [2] who heads that way may be on; several at a fork."""
        distances = {}
        for number, line in enumerate(self.lines):
            distance, heading = _beside(line, point)
            if distance < _ON_LANE_M and abs(wrap_angle(heading - heading_rad)) < _SAME_WAY_RAD:
                distances[number] = distance
        nearest = min(distances.values(), default=0.0)
        return tuple(number for number, each in distances.items() if each <= nearest + _AS_NEAR_M)

    def path_along(self, path: Array) -> LanePath | None:
        """The lanes that a path [n, 2] from the ego's place follows; None where the ego is on no lane.

        The path begins on their first lane. It may leave them: for lane changes they go on beside it.
        """
        length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        ways = [
            way
            for first in self.lanes_at(np.zeros(2), 0.0)
            for way in self._ways((first,), length + _BEYOND_M, length)
        ]
        return min(ways, key=lambda way: _apart(way, path), default=None)

    def _ways(self, lanes: tuple[int, ...], wanted_m: float, reached_m: float) -> Iterator[LanePath]:
        line = _joined([self.lines[lane] for lane in lanes])
        nearest = int(np.linalg.norm(line, axis=1).argmin())
        left_m = float(np.linalg.norm(np.diff(line[nearest:], axis=0), axis=1).sum())
        further = self._follows[lanes[-1]] if left_m < wanted_m and len(lanes) < _MOST_LANES else ()
        if further := tuple(lane for lane in further if lane not in lanes):
            for lane in further:
                yield from self._ways((*lanes, lane), wanted_m, reached_m)
        else:
            yield LanePath(lanes, line, self._at_fork(lanes, reached_m))

    def _at_fork(self, lanes: tuple[int, ...], reached_m: float) -> bool:
        if any(lanes[0] in each and len(each) > 1 for each in self._follows):
            return True
        for before, lane in pairwise(lanes):
            begins_m = float(np.linalg.norm(self.lines[lane][0]))
            if begins_m < reached_m and len(self._follows[before]) > 1:
                return True
        return False


def _follows(lines: Sequence[Array]) -> tuple[tuple[int, ...], ...]:
    if not lines:
        return ()
    # Beginnings [n, 2, 2] and ends [n, 2, 2] of all lines: two points each.
    starts, ends = np.stack([line[:2] for line in lines]), np.stack([line[-2:] for line in lines])
    apart = np.linalg.norm(ends[:, None, 1] - starts[None, :, 0], axis=2)
    turned = np.abs(wrap_angle(_headings(ends)[:, None] - _headings(starts)))
    touches = (apart < _TOUCH_M) & (turned < _SAME_WAY_RAD)
    np.fill_diagonal(touches, val=False)
    return tuple(tuple(np.flatnonzero(row).tolist()) for row in touches)


def _headings(steps: Array) -> Array:
    dx, dy = (steps[:, 1] - steps[:, 0]).T
    headings: Array = np.arctan2(dy, dx)
    return headings


def _beside(line: Array, point: Array) -> tuple[float, float]:
    """How far a line is from a point, and how it heads there."""
    start, step = line[:-1], np.diff(line, axis=0)
    along = np.clip(((point - start) * step).sum(axis=1) / np.maximum((step**2).sum(axis=1), 1e-9), 0, 1)
    distances = np.linalg.norm(start + along[:, None] * step - point, axis=1)
    nearest = int(distances.argmin())
    return float(distances[nearest]), float(np.arctan2(step[nearest, 1], step[nearest, 0]))


def _joined(lines: Sequence[Array]) -> Array:
    points = np.concatenate(lines)
    there = np.ones(len(points), np.bool_)
    there[1:] = np.linalg.norm(np.diff(points, axis=0), axis=1) > _APART_M
    return points[there]


def _apart(way: LanePath, path: Array) -> float:
    return float(np.abs(way.frame.places(path)[:, 1]).mean())
