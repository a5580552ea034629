"""Triangle meshes: the simulator's models made small, and shapes of our own.

Drawn from the simulator's wheel are only the models "beetle", "130", barrier, cone and pedestrian, all
CC-BY 4.0; their textures are baked into vertex colours. Everything else is made here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from clients.metadrive import simulator
from clients.metadrive.actors import BODY_SIZES, VEHICLE_MODELS

Floats = npt.NDArray[np.float32]
Ints = npt.NDArray[np.int32]

_CELL_M: Final = {"beetle": 0.09, "130": 0.09, "barrier": 0.06, "cone": 0.05, "pedestrian": 0.035}
GAIT_POSES: Final = 8
GAIT_CYCLE_M: Final = 1.5
_CLEARANCE_M: Final = 0.17
_GLASS: Final = (0.10, 0.12, 0.15)
_FILES: Final = {
    "beetle": "vehicle/beetle/vehicle.gltf",
    "130": "vehicle/130/vehicle.gltf",
    "barrier": "barrier/scene.gltf",
    "cone": "traffic_cone/scene.gltf",
    "pedestrian": "pedestrian/scene.gltf",
}
_TURN_DEGREES: Final = {"beetle": -90.0, "130": -90.0, "barrier": 90.0, "cone": 0.0, "pedestrian": 90.0}
"""From the model's own forward axis to +x."""


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
    rotation = _rotation(turn)
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


def _rotation(turn: float) -> npt.NDArray[np.float64]:
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])


@cache
def model_meshes(name: str) -> tuple[Mesh, ...]:
    """The meshes of a model, forward along +x, standing on z = 0, of the size in `BODY_SIZES`.

    One mesh; for the pedestrian `GAIT_POSES` of them, one step cycle.
    """
    core = simulator.panda()
    root = core.NodePath(simulator.load_model(_FILES[name]))
    if name != "pedestrian":
        return (_fitted(_baked(root, name, None), name, None),)
    poses = []
    control = core.AnimControlCollection()
    core.autoBind(root.node(), control, 0xFF)
    animation = control.getAnim(0)
    for k in range(GAIT_POSES):
        animation.pose(int(k * animation.getNumFrames() / GAIT_POSES) % animation.getNumFrames())
        for character in root.findAllMatches("**/+Character"):
            character.node().update()
        poses.append(_baked(root, name, core.Thread.getCurrentThread()))
    first = poses[0]
    return tuple(_fitted(pose, name, first) for pose in poses)


def _baked(root: Any, name: str, thread: Any) -> Mesh:
    parts = []
    for found in root.findAllMatches("**/+GeomNode"):
        matrix = np.array([[found.getMat(root).getCell(r, c) for c in range(4)] for r in range(4)])
        node = found.node()
        for k in range(node.getNumGeoms()):
            state = found.getNetState().compose(node.getGeomState(k))
            part = _geom_mesh(node.getGeom(k).decompose(), state, matrix, thread)
            if part is not None:
                parts.append(part)
    return joined(parts)


def _geom_mesh(geom: Any, state: Any, matrix: Any, thread: Any) -> Mesh | None:
    data = geom.getVertexData()
    if thread is not None:
        data = data.animateVertices(True, thread)
    vertices, normals, uv = (
        _column(data, "vertex", 3),
        _column(data, "normal", 3),
        _column(data, "texcoord", 2),
    )
    triangles = []
    for k in range(geom.getNumPrimitives()):
        primitive = geom.getPrimitive(k)
        if primitive.getNumVerticesPerPrimitive() == 3:
            triangles.append([primitive.getVertex(i) for i in range(primitive.getNumVertices())])
    if vertices is None or not triangles:
        return None
    homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1) @ matrix
    turned = (normals if normals is not None else np.tile([0, 0, 1.0], (len(vertices), 1))) @ matrix[:3, :3]
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
    colours = _colours(state, uv, len(vertices))
    return Mesh(
        homogeneous[:, :3].astype(np.float32),
        turned.astype(np.float32),
        colours.astype(np.float32),
        np.concatenate(triangles).reshape(-1, 3).astype(np.int32),
    )


def _column(data: Any, name: str, size: int) -> Any:
    core = simulator.panda()
    layout = data.getFormat()
    wanted = core.InternalName.make(name)
    if name == "texcoord":
        names = [layout.getTexcoord(i) for i in range(layout.getNumTexcoords())]
        if not names:
            return None
        wanted = names[0]
    if not layout.hasColumn(wanted):
        return None
    index = layout.getArrayWith(wanted)
    column = layout.getColumn(wanted)
    if column.getNumericType() != core.Geom.NT_float32:
        reader = core.GeomVertexReader(data, wanted)
        return np.array([tuple(reader.getData4())[:size] for _ in range(data.getNumRows())])
    stride = layout.getArray(index).getStride()
    raw = np.frombuffer(memoryview(data.getArray(index)).cast("B"), np.uint8).reshape(-1, stride)
    start = column.getStart()
    return np.ascontiguousarray(raw[:, start : start + 4 * size]).view(np.float32).astype(np.float64)


def _colours(state: Any, uv: Any, count: int) -> npt.NDArray[np.float64]:
    core = simulator.panda()
    base = np.ones(4)
    material = state.getAttrib(core.MaterialAttrib)
    if material is not None and material.getMaterial() is not None and material.getMaterial().hasBaseColor():
        base = np.array(tuple(material.getMaterial().getBaseColor()))
        base[:3] = base[:3] ** (1 / 2.2)
    colours = np.tile(base, (count, 1))
    textures = state.getAttrib(core.TextureAttrib)
    if textures is not None and uv is not None and textures.getNumOnStages() > 0:
        texture = textures.getOnTexture(textures.getOnStage(0))
        raw = texture.getRamImageAs("RGBA")
        if raw:
            width, height = texture.getXSize(), texture.getYSize()
            image = np.frombuffer(raw, np.uint8).reshape(height, width, 4)
            column = ((uv[:, 0] % 1.0) * (width - 1)).astype(int)
            row = ((uv[:, 1] % 1.0) * (height - 1)).astype(int)
            colours = colours * image[row, column] / 255.0
    glass = colours[:, 3] < 0.6
    colours[glass, :3] = _GLASS
    return colours[:, :3]


def _fitted(mesh: Mesh, name: str, like: Mesh | None) -> Mesh:
    rotation = _rotation(math.radians(_TURN_DEGREES[name]))
    vertices = mesh.vertices @ rotation.T
    normals = (mesh.normals @ rotation.T).astype(np.float32)
    reference = vertices if like is None else like.vertices @ rotation.T
    low, high = reference.min(0), reference.max(0)
    length, width, height = BODY_SIZES[name]
    clearance = _CLEARANCE_M if name in VEHICLE_MODELS else 0.0
    height -= clearance
    scale = (
        height / (high[2] - low[2])
        if name == "pedestrian"
        else np.array([length, width, height]) / (high - low)
    )
    middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    placed = ((vertices - middle) * scale + [0, 0, clearance]).astype(np.float32)
    return _decimated(Mesh(placed, normals, mesh.colours, mesh.triangles), _CELL_M[name])


def _decimated(mesh: Mesh, cell: float) -> Mesh:
    """Vertices within one grid cell merged; triangles that collapse dropped."""
    sharp = (
        np.round(mesh.normals).astype(np.int64)
        if cell < 0.06
        else np.zeros_like(mesh.triangles[:1], np.int64)
    )
    key = np.floor(mesh.vertices / cell).astype(np.int64)
    if len(sharp) == len(key):
        key = np.concatenate([key, sharp], axis=1)
    _, inverse = np.unique(key, axis=0, return_inverse=True)
    inverse = inverse.ravel()
    count = int(inverse.max()) + 1
    weight = np.bincount(inverse, minlength=count)[:, None]

    def averaged(values: Floats) -> Floats:
        summed = np.stack([np.bincount(inverse, values[:, k], count) for k in range(values.shape[1])], axis=1)
        return (summed / weight).astype(np.float32)

    triangles = inverse[mesh.triangles]
    kept = (
        (triangles[:, 0] != triangles[:, 1])
        & (triangles[:, 1] != triangles[:, 2])
        & (triangles[:, 0] != triangles[:, 2])
    )
    triangles = triangles[kept]
    first = np.argmin(triangles, axis=1)[:, None]
    triangles = np.unique(np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1), axis=0)
    normals = averaged(mesh.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
    return Mesh(averaged(mesh.vertices), normals, averaged(mesh.colours), triangles.astype(np.int32))
