"""Places relative to the way to go: metres along a route and to its left."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.trajectory import ROUTE_SPACING_M, FloatArray

_BEHIND_M: Final = 80.0
_BEYOND_M: Final = 80.0
"""The route is straight on this far before its first point and behind its last one."""

Array = npt.NDArray[np.float64]


class RouteFrame:
    """A route [20, 2] as a curved axis; 0 m along is where the ego stands beside it.

    Both ends go on straight, so that what is behind the ego or beyond the route has a place too.
    """

    def __init__(self, route: FloatArray) -> None:
        points = np.asarray(route, np.float64)
        first, last = points[1] - points[0], points[-1] - points[-2]
        first, last = first / np.linalg.norm(first), last / np.linalg.norm(last)
        self._points = np.concatenate(
            [[points[0] - (_BEHIND_M + ROUTE_SPACING_M) * first], points, [points[-1] + _BEYOND_M * last]]
        )
        steps = np.diff(self._points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        self._units = steps / lengths[:, None]
        self._lengths = lengths
        self._starts = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
        self._here = 0.0
        self._here = float(self.places(np.zeros((1, 2)))[0, 0])

    def places(self, points: npt.NDArray[np.floating]) -> Array:
        """Metres along the route and to its left, float64 [n, 2], of points [n, 2] in the ego frame."""
        segment, along, left = self._nearest(np.asarray(points, np.float64))
        return np.stack([self._starts[segment] + along - self._here, left], axis=1)

    def headings(self, points: npt.NDArray[np.floating]) -> Array:
        """The route's heading beside points [n, 2], rad [n] in the ego frame."""
        segment, _, _ = self._nearest(np.asarray(points, np.float64))
        headings: Array = np.arctan2(self._units[segment, 1], self._units[segment, 0])
        return headings

    def _nearest(self, points: Array) -> tuple[npt.NDArray[np.intp], Array, Array]:
        """The nearest segment [n] of each point, how far along it lies, and how far to its left."""
        apart = points[:, None] - self._points[None, :-1]
        along = np.clip((apart * self._units).sum(axis=2), 0.0, self._lengths)
        foot = apart - along[..., None] * self._units
        segment = np.argmin((foot**2).sum(axis=2), axis=1)
        rows = np.arange(len(points))
        unit, there = self._units[segment], apart[rows, segment]
        left = unit[:, 0] * there[:, 1] - unit[:, 1] * there[:, 0]
        return segment, along[rows, segment], left
