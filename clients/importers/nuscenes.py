"""nuScenes (H. Caesar et al., 2020, arXiv:1903.11027), from its published tables, without its devkit.

A folder holds ``v1.0-*`` with the tables, and the pictures that they name, in ``samples`` and ``sweeps``.
Poses are of the rear axle, x forward, y left, z up, in a map's frame. Rotations are quaternions (w, x, y, z)
that turn from a sensor's axes to the car's, and from the car's to the map's. Times are in microseconds.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from looktwice.clients.importers.recording import Array, Recording, RecordingError
from looktwice.clients.importers.resampling import JPEG_QUALITY, PictureFiles, nearest
from looktwice.clients.importers.rotations import matrices
from looktwice.clients.navsim.reprojection import seen_as
from looktwice.model.driving.cameras import CameraSpec
from looktwice.model.driving.images import encode_jpeg

VERSIONS: Final = "v1.0-*"
FRONT: Final = "CAM_FRONT"
BESIDE: Final = ("CAM_FRONT_LEFT", "CAM_FRONT_RIGHT")
_FRONT_SEES_DEGREES: Final = 60.0
"""What the camera in front covers by itself."""

Row = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """A camera's pictures and calibration.

    Attributes:
        pictures: in order of time.
        intrinsics: [3, 3], in pixels.
        rotation: [3, 3], from its axes (x right, y down, z ahead) to the car's.
    """

    pictures: PictureFiles
    intrinsics: Array
    rotation: Array


@dataclass(eq=False)
class _Shot:
    """A picture with its camera's calibration, as `seen_as` takes it; the pictures are free of distortion."""

    image: npt.NDArray[Any] | None
    intrinsics: npt.NDArray[Any] | None
    sensor2lidar_rotation: npt.NDArray[Any] | None
    distortion: npt.NDArray[Any] | None = None


@dataclass(frozen=True, eq=False)
class CameraRow:
    """Cameras beside one another that stand for a wider one.

    Attributes:
        spec: the camera that they stand for.
        cameras: by channel; `FRONT` is one of them.
    """

    spec: CameraSpec
    cameras: Mapping[str, CalibratedCamera]

    def at(self, moment_s: float) -> bytes | None:
        """What they see together, as JPEG; None where one of them took nothing near that moment."""
        numbers = [nearest(camera.pictures, moment_s) for camera in self.cameras.values()]
        there = tuple(number for number in numbers if number is not None)
        return _kept(self, there) if len(there) == len(numbers) else None

    def doubts(self) -> list[str]:
        """That cameras to the side are missing, where they are needed."""
        if self.spec.hfov_degrees <= _FRONT_SEES_DEGREES or len(self.cameras) > len(BESIDE):
            return []
        missing = " and ".join(channel for channel in BESIDE if channel not in self.cameras)
        return [f"there are no pictures of {missing}: the sides of {self.spec.name} are grey"]


@lru_cache(maxsize=32)
def _kept(row: CameraRow, numbers: tuple[int, ...]) -> bytes:
    """What cameras see together; scenes half a second apart share three of four pictures."""
    shots = [
        _Shot(camera.pictures.picture(number), camera.intrinsics, camera.rotation)
        for camera, number in zip(row.cameras.values(), numbers, strict=True)
    ]
    return encode_jpeg(seen_as(row.spec, shots), JPEG_QUALITY)


def read_nuscenes(folder: Path, specs: Iterable[CameraSpec]) -> Iterator[Recording]:
    """Read a folder: a recording for each of its scenes whose pictures are there.

    Raises:
        RecordingError: tables or pictures are missing or damaged.
    """
    tables = _Tables(folder)
    specs = tuple(specs)
    shown = False
    for scene in tables.read("scene"):
        taken = tables.taken(scene)
        cameras = {channel: _camera(folder, tables, taken[channel]) for channel in (FRONT, *BESIDE)}
        there = {channel: camera for channel, camera in cameras.items() if camera is not None}
        if FRONT not in there:
            continue
        shown = True
        times_s, poses = tables.poses(taken)
        eyes = tuple(
            CameraRow(spec, {FRONT: there[FRONT]} if spec.hfov_degrees <= _FRONT_SEES_DEGREES else there)
            for spec in specs
        )
        yield Recording(scene["name"], times_s, poses, eyes)
    if not shown:
        raise RecordingError(f"{folder} has tables, but none of the pictures of {FRONT} that they name")


class _Tables:
    def __init__(self, folder: Path) -> None:
        versions = [path for path in sorted(folder.glob(VERSIONS)) if path.is_dir()]
        if len(versions) != 1:
            found = ", ".join(path.name for path in versions) or "none"
            raise RecordingError(f"{folder} should have one folder of tables {VERSIONS}; there is {found}")
        self.folder = versions[0]
        sensors = {row["token"]: row["channel"] for row in self.read("sensor", "channel")}
        calibrated = self.read("calibrated_sensor", "sensor_token", "rotation", "camera_intrinsic")
        self.calibrated = {row["token"]: row for row in calibrated}
        self._channels = {row["token"]: sensors.get(row["sensor_token"], "") for row in calibrated}
        self._scenes = {row["token"]: row["scene_token"] for row in self.read("sample", "scene_token")}
        self._poses = {
            row["token"]: row for row in self.read("ego_pose", "translation", "rotation", "timestamp")
        }
        self._taken: dict[str, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
        named = ("sample_token", "ego_pose_token", "calibrated_sensor_token", "timestamp", "filename")
        for row in self.read("sample_data", *named):
            channel = self._channels.get(row["calibrated_sensor_token"], "")
            self._taken[self._scenes.get(row["sample_token"], "")][channel].append(row)

    def read(self, name: str, *columns: str) -> list[Row]:
        """A table's rows; raises `RecordingError` for one that is missing, damaged or lacks a column."""
        path = self.folder / f"{name}.json"
        try:
            rows = json.loads(path.read_bytes())
        except (OSError, ValueError) as error:
            raise RecordingError(f"{path} cannot be read: {error}") from error
        needed = {"token", *columns}
        if not isinstance(rows, list) or not all(
            isinstance(row, dict) and needed <= row.keys() for row in rows
        ):
            raise RecordingError(f"{path} is no table with the columns {', '.join(sorted(needed))}")
        return rows

    def taken(self, scene: Row) -> Mapping[str, list[Row]]:
        """What each sensor took in a scene."""
        return self._taken[scene["token"]]

    def poses(self, taken: Mapping[str, Sequence[Row]]) -> tuple[Array, Array]:
        """Times [n] and poses [n, 4] of a scene: there is one for whatever any sensor took."""
        tokens = {row["ego_pose_token"] for rows in taken.values() for row in rows}
        if missing := tokens - self._poses.keys():
            raise RecordingError(f"{self.folder / 'ego_pose.json'} lacks the pose {min(missing)}")
        rows = {self._poses[token]["timestamp"]: self._poses[token] for token in tokens}
        order = sorted(rows)
        turns = matrices(np.array([rows[time]["rotation"] for time in order], np.float64))
        heading = np.unwrap(np.arctan2(turns[:, 1, 0], turns[:, 0, 0]))
        places = np.array([rows[time]["translation"] for time in order], np.float64)
        return np.array(order, np.float64) / 1e6, np.concatenate([places, heading[:, None]], axis=1)


def _camera(folder: Path, tables: _Tables, rows: Sequence[Row]) -> CalibratedCamera | None:
    """A channel in a scene; None where none of its pictures is there."""
    there = [row for row in sorted(rows, key=itemgetter("timestamp")) if (folder / row["filename"]).is_file()]
    if not there:
        return None
    calibrated = tables.calibrated[there[0]["calibrated_sensor_token"]]
    times_s = np.array([row["timestamp"] for row in there], np.float64) / 1e6
    files = PictureFiles(times_s, [folder / row["filename"] for row in there])
    rotation = matrices(np.array(calibrated["rotation"], np.float64))
    return CalibratedCamera(files, np.array(calibrated["camera_intrinsic"], np.float64), rotation)
