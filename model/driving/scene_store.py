"""Labelled scenes in Parquet files: one row a scene, everything a scene knows in it.

A file carries ``looktwice.scene_version`` in its metadata; readers refuse other versions. Files of this
version may lack ``lane_map``, which came later: then it is not known. Where scenes bring what was seen half a
second later, files have a column ``next_frames``; others lack it, as they always did. Files are written to a
temporary name beside their place and renamed, so a reader never meets half a file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from looktwice.model.driving.images import decode_image, encode_png
from looktwice.model.driving.lane_map import LANE_MAP_CM, LaneArea, LaneMap
from looktwice.model.driving.parquet_rows import write_rows
from looktwice.model.driving.scene import (
    Agent,
    AgentKind,
    Clip,
    DenseTarget,
    LabelledScene,
    LaneTrace,
    NextFrame,
    Scene,
    SceneError,
    Tag,
)
from looktwice.model.driving.trajectory import FloatArray, GeometryError

SCENE_VERSION: Final = "2"
_VERSION_KEY: Final = b"looktwice.scene_version"
ROW_GROUP: Final = 128
MANIFEST: Final = "manifest.json"
"""Beside the files of a folder that was generated: how, and how its episodes ended."""

_RANGE_FAR_M: Final = 400.0
"""Ranges of dense targets are stored as 8-bit logarithms of 1 + range: off by at most 1.2 %, up to 400 m."""

_FLOATS = pa.list_(pa.float32())
_RINGS = pa.list_(_FLOATS)
_STEPS = pa.list_(pa.int32())
"""Points of a lane map in centimetres, each as the step from the one before: half the bytes of floats."""
_SCHEMA: Final = pa.schema(
    [
        ("scene_id", pa.string()),
        ("episode_id", pa.string()),
        ("seed", pa.int64()),
        ("clips", pa.list_(pa.struct([("camera", pa.string()), ("images", pa.list_(pa.binary()))]))),
        ("history", _FLOATS),
        ("route", _FLOATS),
        ("future", _FLOATS),
        (
            "agents",
            pa.list_(
                pa.struct(
                    [
                        ("agent_id", pa.int64()),
                        ("kind", pa.string()),
                        ("size_m", _FLOATS),
                        ("poses", _FLOATS),
                        ("lights", pa.list_(pa.string())),
                    ]
                )
            ),
        ),
        ("drivable", _RINGS),
        ("lane_lines", _RINGS),
        (
            "lane_trace",
            pa.struct(
                [("road", pa.list_(pa.int32())), ("lane", pa.list_(pa.int16())), ("offset_m", _FLOATS)]
            ),
        ),
        ("tags", pa.list_(pa.string())),
        (
            "dense",
            pa.list_(
                pa.struct([("camera", pa.string()), ("classes", pa.binary()), ("range_log", pa.binary())])
            ),
        ),
        (
            "lane_map",
            pa.struct(
                [
                    (
                        "lanes",
                        pa.list_(
                            pa.struct([("lane_id", pa.int32()), ("ring", _STEPS), ("on_route", pa.bool_())])
                        ),
                    ),
                    ("intersections", pa.list_(_STEPS)),
                    ("centreline", _STEPS),
                    ("has_lights", pa.bool_()),
                ]
            ),
        ),
    ]
)
_NEXT_FRAMES: Final = pa.field(
    "next_frames", pa.list_(pa.struct([("camera", pa.string()), ("image", pa.binary())]))
)
"""Of files whose first scene has some."""


class SceneFileError(ValueError):
    """A scene file that is missing, truncated, of another version, or holds a row that is no scene."""


def write_scenes(
    path: Path, scenes: Iterable[LabelledScene], metadata: Mapping[str, str] | None = None
) -> int:
    """Write ``scenes`` to one Parquet file and return how many there were; see the module's first lines.

    Raises:
        SceneError: a scene has next frames, and the first one has none. Nothing is written.
    """
    remaining = iter(scenes)
    first = next(remaining, None)
    bring = first is not None and bool(first.next_frames)
    described = {_VERSION_KEY: SCENE_VERSION.encode()} | {
        key.encode(): value.encode() for key, value in (metadata or {}).items()
    }
    schema = (_SCHEMA.append(_NEXT_FRAMES) if bring else _SCHEMA).with_metadata(described)

    def rows() -> Iterator[dict[str, Any]]:
        for labelled in chain([] if first is None else [first], remaining):
            if labelled.next_frames and not bring:
                raise SceneError(
                    f"scene {labelled.scene.scene_id} has next frames, and the first of its file has none: "
                    "write them to another file"
                )
            yield _to_row(labelled)

    return write_rows(path, rows(), schema, ROW_GROUP)


def scene_files(path: Path) -> list[Path]:
    """The Parquet files at ``path``: the file itself, or those in the folder and in its folders, by name."""
    if path.is_dir():
        files = sorted(path.rglob("*.parquet"))
        if not files:
            raise SceneFileError(f"{path} holds no .parquet scene files")
        return files
    if not path.exists():
        raise SceneFileError(f"{path} does not exist")
    return [path]


def count_scenes(path: Path) -> int:
    """How many scenes a file or folder holds, from the files' footers alone."""
    return sum(_open(file).metadata.num_rows for file in scene_files(path))


def row_groups(file: Path) -> list[list[str]]:
    """The names of a file's scenes, row group by row group: parts that can be read by themselves."""
    parquet = _open(file)
    return [
        parquet.read_row_group(group, columns=["scene_id"]).column(0).to_pylist()
        for group in range(parquet.num_row_groups)
    ]


def read_scenes(
    path: Path,
    *,
    dense: bool = True,
    unlabelled: Callable[[str], None] | None = None,
    group: int | None = None,
) -> Iterator[LabelledScene]:
    """Yield the scenes of a file, or of a folder's files by name.

    Args:
        path: a ``.parquet`` file or a folder of them.
        dense: also read the dense targets, which planning and evaluation do not need.
        unlabelled: told the names of scenes without an expert's future, which are left out; such a scene
            is an error where nobody is to be told.
        group: read only this row group of each file.

    Raises:
        SceneFileError: see the class.
    """
    columns = None if dense else [name for name in (*_SCHEMA.names, _NEXT_FRAMES.name) if name != "dense"]
    for file in scene_files(path):
        parquet = _open(file)
        try:
            for number in range(parquet.num_row_groups) if group is None else (group,):
                for row in parquet.read_row_group(number, columns=columns).to_pylist():
                    if row["future"] is None and unlabelled is not None:
                        unlabelled(row["scene_id"])
                        continue
                    yield _from_row(row)
        except (
            MemoryError
        ):  # pyarrow's own, which counts as an `ArrowException` too, says nothing of the file
            raise
        except (pa.ArrowException, OSError) as error:
            raise SceneFileError(f"{file} is damaged: {error}") from error
        except (SceneError, GeometryError, KeyError, TypeError, ValueError) as error:
            raise SceneFileError(f"{file} holds a row that is no scene: {error}") from error


def _open(file: Path) -> pq.ParquetFile:
    try:
        parquet = pq.ParquetFile(file, page_checksum_verification=True)
    except (pa.ArrowException, OSError) as error:
        raise SceneFileError(f"{file} is not a whole Parquet file (truncated?): {error}") from error
    version = (parquet.schema_arrow.metadata or {}).get(_VERSION_KEY)
    if version is None:
        raise SceneFileError(f"{file} is a Parquet file but holds no LookTwice scenes")
    if version.decode() != SCENE_VERSION:
        raise SceneFileError(
            f"{file} has scene version {version.decode()}, this LookTwice reads version {SCENE_VERSION}"
        )
    return parquet


def _flat(array: Any) -> list[float]:
    return np.asarray(array, np.float32).ravel().tolist()


def _to_row(labelled: LabelledScene) -> dict[str, Any]:
    scene, trace = labelled.scene, labelled.lane_trace
    return {
        "scene_id": scene.scene_id,
        "episode_id": labelled.episode_id,
        "seed": labelled.seed,
        "clips": [{"camera": clip.camera, "images": list(clip.images)} for clip in scene.clips],
        "history": _flat(scene.history),
        "route": None if scene.route is None else _flat(scene.route),
        "future": _flat(labelled.future),
        "agents": [
            {
                "agent_id": agent.agent_id,
                "kind": agent.kind,
                "size_m": [agent.length_m, agent.width_m, agent.height_m],
                "poses": _flat(agent.poses),
                "lights": sorted(agent.lights),
            }
            for agent in labelled.agents
        ],
        "drivable": [_flat(ring) for ring in labelled.drivable],
        "lane_lines": [_flat(line) for line in labelled.lane_lines],
        "lane_trace": None
        if trace is None
        else {
            "road": trace.road.tolist(),
            "lane": trace.lane.tolist(),
            "offset_m": _flat(trace.offset_m),
        },
        "tags": sorted(labelled.tags),
        "dense": [
            {
                "camera": target.camera,
                "classes": encode_png(target.classes),
                "range_log": encode_png(_range_to_log(target.range_m)),
            }
            for target in labelled.dense
        ],
        "lane_map": None if labelled.lane_map is None else _lane_map_to_row(labelled.lane_map),
        _NEXT_FRAMES.name: [{"camera": each.camera, "image": each.image} for each in labelled.next_frames],
    }


def _lane_map_to_row(lane_map: LaneMap) -> dict[str, Any]:
    return {
        "lanes": [
            {"lane_id": lane.lane_id, "ring": _to_steps(lane.ring), "on_route": lane.on_route}
            for lane in lane_map.lanes
        ],
        "intersections": [_to_steps(ring) for ring in lane_map.intersections],
        "centreline": _to_steps(lane_map.centreline),
        "has_lights": lane_map.has_lights,
    }


def _lane_map(row: dict[str, Any]) -> LaneMap:
    return LaneMap(
        tuple(
            LaneArea(lane["lane_id"], _from_steps(lane["ring"]), lane["on_route"]) for lane in row["lanes"]
        ),
        tuple(_from_steps(ring) for ring in row["intersections"]),
        _from_steps(row["centreline"]),
        row["has_lights"],
    )


def _to_steps(points: FloatArray) -> list[int]:
    centimetres = np.round(points.astype(np.float64) * LANE_MAP_CM).astype(np.int64)
    steps: list[int] = np.diff(centimetres, axis=0, prepend=np.zeros((1, 2), np.int64)).ravel().tolist()
    return steps


def _from_steps(steps: list[int]) -> Any:
    return np.cumsum(np.asarray(steps, np.int64).reshape(-1, 2), axis=0) / LANE_MAP_CM


def _array(values: list[float], columns: int) -> Any:
    return np.asarray(values, np.float32).reshape(-1, columns)


def _from_row(row: dict[str, Any]) -> LabelledScene:
    trace = row["lane_trace"]
    return LabelledScene(
        scene=Scene(
            scene_id=row["scene_id"],
            clips=tuple(Clip(clip["camera"], tuple(clip["images"])) for clip in row["clips"]),
            history=_array(row["history"], 4),
            route=None if row["route"] is None else _array(row["route"], 2),
        ),
        episode_id=row["episode_id"],
        seed=row["seed"],
        future=_array(row["future"], 4),
        agents=tuple(_agent(agent) for agent in row["agents"]),
        drivable=tuple(_array(ring, 2) for ring in row["drivable"]),
        lane_lines=tuple(_array(line, 2) for line in row["lane_lines"]),
        lane_trace=None
        if trace is None
        else LaneTrace(
            np.asarray(trace["road"], np.int32),
            np.asarray(trace["lane"], np.int16),
            np.asarray(trace["offset_m"], np.float32),
        ),
        tags=frozenset(cast("list[Tag]", row["tags"])),
        dense=tuple(
            DenseTarget(
                target["camera"],
                decode_image(target["classes"])[..., 0],
                _log_to_range(decode_image(target["range_log"])[..., 0]),
            )
            for target in row.get("dense") or ()
        ),
        lane_map=_lane_map(told) if (told := row.get("lane_map")) is not None else None,
        next_frames=tuple(
            NextFrame(each["camera"], each["image"]) for each in row.get(_NEXT_FRAMES.name) or ()
        ),
    )


def _agent(row: dict[str, Any]) -> Agent:
    length_m, width_m, height_m = row["size_m"]
    return Agent(
        agent_id=row["agent_id"],
        kind=cast(AgentKind, row["kind"]),
        length_m=length_m,
        width_m=width_m,
        height_m=height_m,
        poses=_array(row["poses"], 3),
        lights=frozenset(row["lights"]),
    )


def _range_to_log(range_m: Any) -> Any:
    scaled = 255 * np.log1p(np.clip(range_m, 0, _RANGE_FAR_M)) / np.log1p(_RANGE_FAR_M)
    return np.round(scaled).astype(np.uint8)


def _log_to_range(stored: Any) -> Any:
    return np.expm1(stored.astype(np.float32) / 255 * np.log1p(np.float32(_RANGE_FAR_M)))
