"""The simulator's models as small meshes.

Drawn from the simulator's wheel are only the models "beetle", "130", barrier, cone and pedestrian, all
CC-BY 4.0; their textures are baked into vertex colours.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from looktwice.clients.metadrive import simulator
from looktwice.clients.metadrive.drawing.meshes import Floats, Mesh, joined, rotation_about_z
from looktwice.clients.metadrive.world.actors import BODY_SIZES, VEHICLE_MODELS

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
    rotation = rotation_about_z(math.radians(_TURN_DEGREES[name]))
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
