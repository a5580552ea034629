"""Triangle meshes: what they are, and the plain shapes that scenery is built of."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from looktwice.clients.metadrive import simulator

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices, normals, colours [n, 3], triangles [m, 3], and texture coordinates [n, 2] or None."""

    vertices: Floats
    normals: Floats
    colours: Floats
    triangles: Ints
    uv: Floats | None = None

    def node(self, name: str) -> Any:
        """A Panda3D node that draws the mesh."""
        core = simulator.panda()
        array = core.GeomVertexArrayFormat()
        columns = [("vertex", 3, core.Geom.C_point), ("normal", 3, core.Geom.C_normal)]
        for column, size, contents in columns:
            array.addColumn(column, size, core.Geom.NT_float32, contents)
        array.addColumn("color", 4, core.Geom.NT_float32, core.Geom.C_color)
        array.addColumn("texcoord", 2, core.Geom.NT_float32, core.Geom.C_texcoord)
        layout = core.GeomVertexFormat()
        layout.addArray(array)
        layout = core.GeomVertexFormat.registerFormat(layout)
        count = len(self.vertices)
        data = core.GeomVertexData(name, layout, core.Geom.UHStatic)
        data.uncleanSetNumRows(count)
        uv = self.uv if self.uv is not None else np.zeros((count, 2), np.float32)
        rows = np.concatenate(
            [self.vertices, self.normals, self.colours, np.ones((count, 1), np.float32), uv], axis=1
        ).astype(np.float32)
        memoryview(data.modifyArray(0)).cast("B")[:] = rows.tobytes()
        triangles = core.GeomTriangles(core.Geom.UHStatic)
        triangles.setIndexType(core.Geom.NT_uint32)
        indices = triangles.modifyVertices()
        indices.uncleanSetNumRows(self.triangles.size)
        memoryview(indices).cast("B")[:] = self.triangles.astype(np.uint32).tobytes()
        geom = core.Geom(data)
        geom.addPrimitive(triangles)
        node = core.GeomNode(name)
        node.addGeom(geom)
        return core.NodePath(node)


def joined(meshes: list[Mesh]) -> Mesh:
    """One mesh of many."""
    starts = np.cumsum([0, *[len(mesh.vertices) for mesh in meshes]])
    with_uv = all(mesh.uv is not None for mesh in meshes)
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.colours for mesh in meshes]),
        np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]),
        np.concatenate([mesh.uv for mesh in meshes if mesh.uv is not None]) if with_uv else None,
    )


def box(
    centre: tuple[float, float, float], size: tuple[float, float, float], colour: Any, turn: float = 0.0
) -> Mesh:
    """An upright box, turned about its vertical axis."""
    vertices: list[Any] = []
    normals: list[Any] = []
    triangles: list[Any] = []
    half = np.array(size) / 2
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = sign
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            start = len(vertices)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                vertices.append((normal + a * u + b * v) * half)
                normals.append(normal)
            order = (0, 1, 2, 0, 2, 3) if sign > 0 else (0, 2, 1, 0, 3, 2)
            triangles.append(np.array(order).reshape(2, 3) + start)
    rotation = rotation_about_z(turn)
    placed = np.array(vertices) @ rotation.T + np.array(centre)
    return _solid(placed, np.array(normals) @ rotation.T, np.concatenate(triangles), colour)


def spike(
    centre: tuple[float, float, float], radius: float, height: float, colour: Any, sides: int = 8
) -> Mesh:
    """A cone that stands on ``centre``: a tree's crown."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(sides)], axis=1)
    vertices = np.concatenate([ring, [[0, 0, height]]]) + np.array(centre)
    normals = np.concatenate([ring / radius + [0, 0, 0.4], [[0, 0, 1.0]]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = np.array([[k, (k + 1) % sides, sides] for k in range(sides)])
    return _solid(vertices, normals, triangles, colour)


def strip(left: Any, right: Any, colour: Any, uv_scale: float | None = None) -> Mesh:
    """A flat ribbon between two lines [n, 2] of equal length."""
    count = len(left)
    flat = np.concatenate([left, right])
    i = np.arange(count - 1)
    triangles = np.concatenate(
        [np.stack([i + count, i + count + 1, i], axis=1), np.stack([i + count + 1, i + 1, i], axis=1)]
    )
    return flat_mesh(flat, triangles, colour, uv_scale)


def flat_mesh(points: Any, triangles: Any, colour: Any, uv_scale: float | None = None) -> Mesh:
    """A mesh on the ground."""
    vertices = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    mesh = _solid(vertices, normals, triangles, colour)
    uv = None if uv_scale is None else (np.asarray(points) / uv_scale).astype(np.float32)
    return Mesh(mesh.vertices, mesh.normals, mesh.colours, mesh.triangles, uv)


def _solid(vertices: Any, normals: Any, triangles: Any, colour: Any) -> Mesh:
    return Mesh(
        np.asarray(vertices, np.float32),
        np.asarray(normals, np.float32),
        np.tile(np.asarray(colour, np.float32), (len(vertices), 1)),
        np.asarray(triangles, np.int32),
    )


def rotation_about_z(turn: float) -> npt.NDArray[np.float64]:
    """The rotation [3, 3] by ``turn`` radians, counter-clockwise seen from above."""
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
