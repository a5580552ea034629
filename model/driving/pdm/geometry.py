"""Points in areas, boxes on boxes and points beside lines, for many at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.driving.pdm.world import Area, Array, BoolArray

IndexArray = npt.NDArray[np.intp]


class Points:
    """Points [m, 2] sorted by y, so that an edge is compared with those only whose height it spans."""

    def __init__(self, points: Array) -> None:
        self._order = np.argsort(points[:, 1], kind="stable")
        self._x, self._y = points[self._order].T.copy()
        self._low = points.min(axis=0, initial=np.inf)
        self._high = points.max(axis=0, initial=-np.inf)

    def inside_each(self, areas: Sequence[Area]) -> BoolArray:
        """bool [areas, m]: inside each by the even-odd rule; a point on a border may fall on either side."""
        count = len(self._y)
        result = np.zeros((len(areas), count), dtype=np.bool_)
        close = [
            number
            for number, area in enumerate(areas)
            if (area.low <= self._high).all() and (area.high >= self._low).all()
        ]
        if not close:
            return result
        edges = np.concatenate([areas[number].edges for number in close])
        owner = np.repeat(np.arange(len(close)), [len(areas[number].edges) for number in close])
        low, high = np.minimum(edges[:, 1], edges[:, 3]), np.maximum(edges[:, 1], edges[:, 3])
        edge, point = _pairs(np.searchsorted(self._y, low), np.searchsorted(self._y, high))
        rise = np.where(high > low, edges[:, 3] - edges[:, 1], 1.0)
        slope = (edges[:, 2] - edges[:, 0]) / rise
        left = self._x[point] < (self._y[point] - edges[edge, 1]) * slope[edge] + edges[edge, 0]
        crossed = np.bincount(owner[edge[left]] * count + point[left], minlength=len(close) * count)
        result[np.ix_(np.array(close), self._order)] = (crossed & 1).reshape(len(close), count)
        return result

    def inside(self, area: Area) -> BoolArray:
        """bool [m]: inside ``area``."""
        result: BoolArray = self.inside_each([area])[0]
        return result

    def inside_any(self, areas: Sequence[Area]) -> BoolArray:
        """bool [m]: inside at least one of ``areas``."""
        result: BoolArray = np.logical_or.reduce(self.inside_each(areas), axis=0)
        return result


def _pairs(first: IndexArray, last: IndexArray) -> tuple[IndexArray, IndexArray]:
    """For ranges first..last of rows: each pair of a range's number and one of its rows."""
    counts = np.maximum(last - first, 0)
    which = np.repeat(np.arange(len(counts)), counts)
    before = np.cumsum(counts) - counts
    return which, np.arange(len(which)) - before[which] + first[which]


@dataclass(frozen=True, eq=False)
class Boxes:
    """Oriented boxes of any one shape.

    Attributes:
        x, y: centres.
        cos, sin: of the headings.
        half_length, half_width: half of the sides, in metres.
    """

    x: Array
    y: Array
    cos: Array
    sin: Array
    half_length: Array
    half_width: Array

    @property
    def radius(self) -> Array:
        """From the centre to a corner."""
        return np.hypot(self.half_length, self.half_width)

    @classmethod
    def of(cls, x: Array, y: Array, heading: Array, length_m: Array, width_m: Array) -> Boxes:
        """Boxes of headings in radians and whole sides; what is given is broadcast."""
        shape = np.broadcast_shapes(x.shape, length_m.shape)
        sides = (np.broadcast_to(side / 2, shape) for side in (length_m, width_m))
        return cls(x, y, np.cos(heading), np.sin(heading), *sides)

    def __getitem__(self, index: Any) -> Boxes:
        parts = (self.x, self.y, self.cos, self.sin, self.half_length, self.half_width)
        return Boxes(*(part[index] for part in parts))

    def flat(self) -> Boxes:
        """The same boxes in one row."""
        parts = (self.x, self.y, self.cos, self.sin, self.half_length, self.half_width)
        return Boxes(*(part.reshape(-1) for part in parts))

    def corners(self) -> Array:
        """[..., 4, 2]: front left, rear left, rear right, front right."""
        along = np.stack([self.cos, self.sin], axis=-1) * self.half_length[..., None]
        aside = np.stack([-self.sin, self.cos], axis=-1) * self.half_width[..., None]
        centre = np.stack([self.x, self.y], axis=-1)
        return np.stack(
            [centre + along + aside, centre - along + aside, centre - along - aside, centre + along - aside],
            axis=-2,
        )


def near(ego: Boxes, others: Boxes) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Where circles around the boxes meet: indices (plan, step, other) of ego [n, t] and others [t, a]."""
    if not others.x.size or not ego.x.size:
        nothing = np.zeros(0, dtype=np.intp)
        return nothing, nothing, nothing
    reach = others.radius + ego.radius[0, 0]
    # Others that no plan comes near to, at any step, are left out before plans are looked at one by one.
    low_x, high_x = ego.x.min(axis=0)[:, None], ego.x.max(axis=0)[:, None]
    low_y, high_y = ego.y.min(axis=0)[:, None], ego.y.max(axis=0)[:, None]
    gap_x = np.maximum(low_x - others.x, others.x - high_x)
    gap_y = np.maximum(low_y - others.y, others.y - high_y)
    steps, which = np.nonzero((gap_x <= reach) & (gap_y <= reach))
    gap_x = ego.x[:, steps] - others.x[steps, which]
    gap_y = ego.y[:, steps] - others.y[steps, which]
    plans, pairs = np.nonzero(gap_x * gap_x + gap_y * gap_y <= (reach[steps, which] + 1e-9) ** 2)
    return plans, steps[pairs], which[pairs]


def boxes_meet(one: Boxes, other: Boxes) -> BoolArray:
    """Whether boxes share a point, pair by pair: no side of either separates them."""
    across, along = other.x - one.x, other.y - one.y
    cos = np.abs(one.cos * other.cos + one.sin * other.sin)
    sin = np.abs(one.cos * other.sin - one.sin * other.cos)
    result: BoolArray = (
        np.abs(across * one.cos + along * one.sin)
        <= one.half_length + other.half_length * cos + other.half_width * sin
    )
    result &= (
        np.abs(along * one.cos - across * one.sin)
        <= one.half_width + other.half_length * sin + other.half_width * cos
    )
    result &= (
        np.abs(across * other.cos + along * other.sin)
        <= other.half_length + one.half_length * cos + one.half_width * sin
    )
    result &= (
        np.abs(along * other.cos - across * other.sin)
        <= other.half_width + one.half_length * sin + one.half_width * cos
    )
    return result


def segments_meet(start: Array, end: Array, boxes: Boxes) -> BoolArray:
    """Whether segments [m, 2] to [m, 2] share a point with boxes [m], pair by pair."""

    def seen(points: Array) -> tuple[Array, Array]:
        x, y = points[..., 0] - boxes.x, points[..., 1] - boxes.y
        return x * boxes.cos + y * boxes.sin, y * boxes.cos - x * boxes.sin

    (from_x, from_y), (to_x, to_y) = seen(start), seen(end)
    result: BoolArray = (np.minimum(from_x, to_x) <= boxes.half_length) & (
        np.maximum(from_x, to_x) >= -boxes.half_length
    )
    result &= (np.minimum(from_y, to_y) <= boxes.half_width) & (np.maximum(from_y, to_y) >= -boxes.half_width)
    x, y = to_x - from_x, to_y - from_y
    reach = boxes.half_length * np.abs(y) + boxes.half_width * np.abs(x)
    result &= np.abs(from_x * y - from_y * x) <= reach
    return result


def area_meets(area: Area, boxes: Boxes) -> BoolArray:
    """Whether boxes [m] share a point with ``area``."""
    result = np.zeros(boxes.x.shape, dtype=np.bool_)
    low, high = area.low, area.high
    reach = boxes.radius
    close = np.flatnonzero(
        (boxes.x + reach >= low[0])
        & (boxes.x - reach <= high[0])
        & (boxes.y + reach >= low[1])
        & (boxes.y - reach <= high[1])
    )
    if not len(close):
        return result
    there = boxes[close]
    # Either a border of one runs through the other, or one lies within the other: an area's border
    # within the box, or the box's centre within the area.
    found = Points(np.stack([there.x, there.y], axis=-1)).inside(area)
    for edge in area.edges:
        open_ = np.flatnonzero(~found)
        if not len(open_):
            break
        found[open_] = segments_meet(edge[:2], edge[2:], there[open_])
    result[close] = found
    return result


def beside_line(points: Array, line: Array, within_m: float) -> BoolArray:
    """bool [m]: farther than ``within_m`` from the line [k, 2] through points [k, 2]."""
    axis = int(np.ptp(points, axis=0).argmax()) if len(points) else 0
    order = np.argsort(points[:, axis], kind="stable")
    sorted_ = points[order]
    along = sorted_[:, axis]
    low = np.minimum(line[:-1, axis], line[1:, axis]) - within_m
    high = np.maximum(line[:-1, axis], line[1:, axis]) + within_m
    segment, point = _pairs(np.searchsorted(along, low), np.searchsorted(along, high, side="right"))
    way = np.diff(line, axis=0)
    squares = (way * way).sum(axis=1)
    scaled = way / np.where(squares > 0, squares, 1.0)[:, None]
    off = sorted_[point] - line[segment]
    share = np.clip((off * scaled[segment]).sum(axis=1), 0.0, 1.0)
    gap = off - share[:, None] * way[segment]
    close = (gap * gap).sum(axis=1) <= within_m * within_m
    result = np.ones(len(points), dtype=np.bool_)
    result[order[point[close]]] = False
    return result


class OnLine(NamedTuple):
    """The places of a line that are nearest to points, [m] each.

    Attributes:
        along_m: how far along the line they are.
        beside_m: how far the points are from them.
        segment: the line's segments that hold them.
    """

    along_m: Array
    beside_m: Array
    segment: IndexArray


def on_line(points: Array, line: Array) -> OnLine:
    """The places of the line [k, 2] that are nearest to points [m, 2]."""
    start, way = line[:-1], np.diff(line, axis=0)
    lengths = np.hypot(way[:, 0], way[:, 1])
    until = np.concatenate([[0.0], np.cumsum(lengths)])
    squares = np.where(lengths > 0, lengths**2, 1.0)
    along, beside = np.empty(len(points)), np.empty(len(points))
    segment = np.empty(len(points), dtype=np.intp)
    for begin in range(0, len(points), 1024):
        off = points[begin : begin + 1024, None] - start
        share = np.clip((off * way).sum(axis=-1) / squares, 0.0, 1.0)
        gap = off - share[..., None] * way
        square = (gap * gap).sum(axis=-1)
        nearest = square.argmin(axis=1)
        rows = np.arange(len(nearest))
        along[begin : begin + 1024] = until[nearest] + share[rows, nearest] * lengths[nearest]
        beside[begin : begin + 1024] = np.sqrt(square[rows, nearest])
        segment[begin : begin + 1024] = nearest
    return OnLine(along, beside, segment)


def to_edges(points: Array, edges: Array) -> Array:
    """Distance of points [m, 2] to the nearest of edges [e, 4], in metres."""
    start, way = edges[:, :2], edges[:, 2:] - edges[:, :2]
    squares = (way * way).sum(axis=1)
    squares = np.where(squares > 0, squares, 1.0)
    result = np.empty(len(points))
    for begin in range(0, len(points), 512):
        off = points[begin : begin + 512, None] - start
        share = np.clip((off * way).sum(axis=-1) / squares, 0.0, 1.0)
        gap = off - share[..., None] * way
        result[begin : begin + 512] = np.sqrt((gap * gap).sum(axis=-1).min(axis=1))
    return result


def gaps(one: Boxes, other: Boxes) -> Array:
    """Metres between boxes, pair by pair; 0 where they meet."""
    first, second = one.corners(), other.corners()
    apart = np.minimum(_corner_gap(first, second), _corner_gap(second, first))
    return np.where(boxes_meet(one, other), 0.0, apart)


def _corner_gap(corners: Array, ring: Array) -> Array:
    """The least distance of corners [m, 4, 2] to the sides of rings [m, 4, 2], pair by pair."""
    start, way = ring[:, None], (np.roll(ring, -1, axis=1) - ring)[:, None]
    off = corners[:, :, None] - start
    share = np.clip((off * way).sum(axis=-1) / (way * way).sum(axis=-1), 0.0, 1.0)
    gap = off - share[..., None] * way
    result: Array = np.sqrt((gap * gap).sum(axis=-1)).min(axis=(1, 2))
    return result


def crosses_itself(ring: Array) -> bool:
    """Whether two sides of a ring [k, 2] that are no neighbours share a point."""
    count = len(ring)
    start, end = ring, np.roll(ring, -1, axis=0)

    def side(points: Array) -> Array:
        """Of each edge (rows) and point (columns): on which side of it, as a sign."""
        way, off = (end - start)[:, None], points[None] - start[:, None]
        return np.sign(way[..., 0] * off[..., 1] - way[..., 1] * off[..., 0])

    from_, to = side(start), side(end)
    apart = (from_ * to <= 0) & (from_ * to <= 0).T
    low, high = np.minimum(start, end), np.maximum(start, end)
    apart &= ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=-1)
    rows = np.arange(count)
    apart[rows, rows] = apart[rows, (rows + 1) % count] = apart[rows, rows - 1] = False
    return bool(apart.any())
