"""The look of a map: asphalt, markings, ground, trees and houses, all generated; colours vary by seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from looktwice.clients.metadrive import simulator
from looktwice.clients.metadrive.drawing.meshes import Mesh, box, flat_mesh, joined, spike, strip
from looktwice.clients.metadrive.world.roads import RoadLane, RoadMap

_MARK_M: Final = 0.16
_DASH_M: Final = (3.0, 6.0)
_KERB_M: Final = 0.25
_GROUND_TILE_M: Final = 14.0
_ASPHALT_TILE_M: Final = 7.0
_WHITE: Final = (0.92, 0.92, 0.90)
_YELLOW: Final = (0.90, 0.70, 0.16)


@dataclass(frozen=True)
class Appearance:
    """Colours and light of one episode."""

    sky: tuple[float, float, float]
    ground: tuple[float, float, float]
    asphalt: float
    sun: tuple[float, float, float]
    sun_heading: float
    sun_height: float
    ambient: float


def make_appearance(seed: int) -> Appearance:
    """The look of the episode of ``seed``."""
    rng = np.random.default_rng([seed, 3])
    skies = [
        (0.55, 0.74, 0.93),
        (0.70, 0.80, 0.90),
        (0.78, 0.80, 0.82),
        (0.90, 0.78, 0.66),
        (0.45, 0.62, 0.85),
    ]
    grounds = [
        (0.34, 0.45, 0.24),
        (0.44, 0.46, 0.30),
        (0.52, 0.46, 0.36),
        (0.30, 0.40, 0.26),
        (0.58, 0.54, 0.46),
    ]
    sky = np.array(skies[int(rng.integers(5))]) + rng.uniform(-0.05, 0.05)
    ground = np.array(grounds[int(rng.integers(5))]) * rng.uniform(0.85, 1.15)
    warm = rng.uniform(-0.06, 0.06)
    sun = np.clip(rng.uniform(0.45, 0.75) + np.array([warm, 0.0, -warm]), 0, 1)
    return Appearance(
        _rgb(sky),
        _rgb(ground),
        float(rng.uniform(0.26, 0.42)),
        _rgb(sun),
        float(rng.uniform(0, 360)),
        float(rng.uniform(30, 70)),
        float(rng.uniform(0.42, 0.6)),
    )


def _rgb(values: npt.NDArray[np.float64]) -> tuple[float, float, float]:
    r, g, b = np.clip(values, 0, 1).tolist()
    return r, g, b


def noise_texture(seed: int, size: int, contrast: float, name: str) -> Any:
    """A tileable grey noise texture around white, to be multiplied with a colour."""
    rng = np.random.default_rng([seed, 4])
    image = np.zeros((size, size))
    for octave in (4, 8, 16, 32, size // 2):
        coarse = rng.normal(size=(octave, octave))
        spectrum = np.zeros((size, size), complex)
        transformed = np.fft.fftshift(np.fft.fft2(coarse))
        low = size // 2 - octave // 2
        spectrum[low : low + octave, low : low + octave] = transformed
        layer = np.real(np.fft.ifft2(np.fft.ifftshift(spectrum)))
        image += layer / layer.std()
    image = np.clip(215 + 40 * contrast * image / image.std(), 0, 255).astype(np.uint8)
    core = simulator.panda()
    texture = core.Texture(name)
    texture.setup2dTexture(size, size, core.Texture.TUnsignedByte, core.Texture.FLuminance)
    texture.setRamImage(image.tobytes())
    texture.setWrapU(core.SamplerState.WMRepeat)
    texture.setWrapV(core.SamplerState.WMRepeat)
    texture.setMinfilter(core.SamplerState.FTLinearMipmapLinear)
    texture.setMagfilter(core.SamplerState.FTLinear)
    return texture


def road_mesh(road_map: RoadMap, grey: float) -> Mesh:
    """The whole road surface."""
    return _area_mesh(road_map.drivable, (grey, grey, grey * 1.03), _ASPHALT_TILE_M)


def kerb_mesh(road_map: RoadMap) -> Mesh:
    """A light rim around the road."""
    rim = road_map.drivable.boundary.buffer(_KERB_M / 2, cap_style="flat", join_style="mitre")
    return _area_mesh(rim, (0.62, 0.61, 0.58), None)


def ground_mesh(road_map: RoadMap, colour: tuple[float, float, float]) -> Mesh:
    """A plane far beyond the road."""
    x0, y0, x1, y1 = road_map.drivable.bounds
    xs, ys = np.linspace(x0 - 600, x1 + 600, 24), np.linspace(y0 - 600, y1 + 600, 24)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    i = (np.arange(23)[:, None] * 24 + np.arange(23)).ravel()
    triangles = np.concatenate([np.stack([i, i + 1, i + 25], 1), np.stack([i, i + 25, i + 24], 1)])
    return flat_mesh(grid, triangles, colour, _GROUND_TILE_M)


def _area_mesh(area: Any, colour: tuple[float, float, float], tile_m: float | None) -> Mesh:
    core = simulator.panda()
    meshes = []
    for part in getattr(area, "geoms", [area]):
        triangulator = core.Triangulator()
        points: list[tuple[float, float]] = []

        def add(ring: Any, adder: Any, triangulator: Any = triangulator, points: Any = points) -> None:
            for x, y in list(ring.coords)[:-1]:
                points.append((x, y))
                adder(triangulator.addVertex(x, y))

        add(part.exterior, triangulator.addPolygonVertex)
        for hole in part.interiors:
            triangulator.beginHole()
            add(hole, triangulator.addHoleVertex)
        triangulator.triangulate()
        triangles = np.array(
            [
                [triangulator.getTriangleV0(k), triangulator.getTriangleV1(k), triangulator.getTriangleV2(k)]
                for k in range(triangulator.getNumTriangles())
            ]
        )
        meshes.append(flat_mesh(np.array(points), triangles, colour, tile_m))
    return joined(meshes)


def marking_mesh(road_map: RoadMap) -> Mesh:
    """Lane lines: white between and beside lanes, yellow between the directions."""
    pieces: list[Mesh] = []
    for lane in road_map.lanes:
        if lane.right_mark != "none":
            pieces += _line(lane, -lane.width / 2, lane.right_mark == "broken", _WHITE)
        if lane.number == 0 and lane.left_mark != "none":
            pieces += _line(lane, lane.width / 2, lane.left_mark == "broken", _YELLOW)
    return joined(pieces)


def _line(lane: RoadLane, offset: float, dashed: bool, colour: tuple[float, float, float]) -> list[Mesh]:
    left, right = lane.edge(offset + _MARK_M / 2), lane.edge(offset - _MARK_M / 2)
    if not dashed:
        return [strip(left, right, colour)]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane.centre, axis=0).T))])
    pieces = []
    for start in np.arange(0.0, s[-1] - _DASH_M[0], sum(_DASH_M)):
        at = np.linspace(start, start + _DASH_M[0], 3)
        ends = [
            np.stack([np.interp(at, s, side[:, 0]), np.interp(at, s, side[:, 1])], 1)
            for side in (left, right)
        ]
        pieces.append(strip(ends[0], ends[1], colour))
    return pieces


def roadside_mesh(road_map: RoadMap, seed: int) -> Mesh:
    """Houses and trees beside the road."""
    rng = np.random.default_rng([seed, 5])
    outline = road_map.drivable.buffer(4.5)
    shapely.prepare(outline)
    density = float(rng.choice([14.0, 22.0, 45.0]))
    urban = float(rng.uniform(0.1, 0.7))
    meshes: list[Mesh] = [box((0, 0, -5), (0.1, 0.1, 0.1), (0, 0, 0))]
    for rail in (*road_map.rails[:1], *road_map.oncoming_rails[:1]):
        s = 0.0
        while s < rail.length:
            side = -1.0 if rng.random() < 0.85 else 1.0
            x, y, heading = rail.pose(s, side * float(rng.uniform(9, 45)))
            if rng.random() < urban:
                size = (float(rng.uniform(7, 16)), float(rng.uniform(6, 12)), float(rng.uniform(3.5, 14)))
                shade = np.array([0.70, 0.64, 0.56]) * rng.uniform(0.6, 1.2) + rng.uniform(-0.08, 0.08, 3)
                footprint = shapely.Point(x, y).buffer(0.6 * max(size[:2]))
                piece = [box((x, y, size[2] / 2), size, np.clip(shade, 0, 1), heading)]
            else:
                radius, height = float(rng.uniform(1.2, 2.8)), float(rng.uniform(4, 9))
                green = np.array([0.20, 0.36, 0.16]) * rng.uniform(0.7, 1.3)
                footprint = shapely.Point(x, y).buffer(radius)
                piece = [
                    box((x, y, 0.8), (0.35, 0.35, 1.6), (0.32, 0.24, 0.17)),
                    spike((x, y, 1.3), radius, height, np.clip(green, 0, 1)),
                ]
            if not outline.intersects(footprint):
                meshes += piece
            s += float(rng.exponential(density)) + 3.0
    return joined(meshes)
