"""Segments of comma2k19 (H. Schafer et al., 2018, arXiv:1812.05752): film and poses.

A segment's folder holds ``video.hevc``, 20 pictures a second of the camera behind the windscreen, and
``global_pose`` with an array each of times, of places in the earth-centred, earth-fixed frame (ECEF, WGS 84)
and of orientations: quaternions (w, x, y, z) that turn from the camera's axes (x forward, y right, z down) to
that frame. A pose is the camera's; it is taken for the car's, but for the angle of its mount.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from cachetools import FIFOCache

from looktwice.clients.importers.recording import Array, Recording, RecordingError
from looktwice.clients.importers.resampling import OneCamera, RgbImage, Source, fov_of
from looktwice.clients.importers.rotations import matrices
from looktwice.model.driving.cameras import CameraSpec

POSES_FOLDER: Final = "global_pose"
FILM: Final = "video.hevc"
FOCAL_PX: Final = 910.0
"""Of the camera of every segment, whose pictures have 1164 by 874 pixels."""
WIDTH_PX, HEIGHT_PX = 1164, 874
_REMEMBERED: Final = 40
"""Pictures, two seconds: a clip looks back by 1.5 s, and a film is read forwards."""
_MOVING_MPS: Final = 3.0
_WGS84_SEMI_AXES_M: Final = np.array([6378137.0, 6378137.0, 6356752.3142])


@dataclass(eq=False)
class FilmReader:
    """A film, read forwards; what was read shortly before is remembered.

    Attributes:
        path: of the file.
        times_s: of its pictures, [n].
    """

    path: Path
    times_s: Array
    _remembered: FIFOCache[int, RgbImage] = field(default_factory=lambda: FIFOCache(_REMEMBERED))
    _reader: Iterator[RgbImage] | None = None
    _next: int = 0

    def picture(self, number: int) -> RgbImage:
        """One of its pictures, RGB; raises `RecordingError` where the film ends before or is damaged."""
        if number not in self._remembered:
            if self._reader is None or number < self._next:
                self._reader, self._next = self._read(), 0
            for picture in self._reader:
                self._remembered[self._next] = picture
                self._next += 1
                if self._next > number:
                    break
        if number not in self._remembered:
            raise RecordingError(f"{self.path} ends after {self._next} pictures; there are poses of more")
        return self._remembered[number]

    def _read(self) -> Iterator[RgbImage]:
        if not self.path.is_file():
            raise RecordingError(f"{self.path} is missing")
        try:
            import cv2
        except ImportError as error:
            raise RecordingError("films take OpenCV: pip install 'looktwice[video]'") from error
        film = cv2.VideoCapture(str(self.path))
        try:
            while True:
                found, picture = film.read()
                if not found:
                    return
                yield np.ascontiguousarray(picture[..., ::-1], np.uint8)
        finally:
            film.release()


def read_segments(folder: Path, specs: Iterable[CameraSpec]) -> Iterator[Recording]:
    """Read a segment's folder, or all segments within a folder, in order.

    Raises:
        RecordingError: there is none, or one is damaged.
    """
    segments = sorted(path.parent for path in folder.rglob(POSES_FOLDER))
    if not segments:
        raise RecordingError(f"{folder} has no {POSES_FOLDER}, as comma2k19's segments have")
    specs = tuple(specs)
    for segment in segments:
        yield _read_segment(segment, specs)


def _read_segment(folder: Path, specs: tuple[CameraSpec, ...]) -> Recording:
    times_s = _array(folder, "frame_times", ())
    places = _array(folder, "frame_positions", (3,))
    turns = matrices(_array(folder, "frame_orientations", (4,)))
    if not len(times_s) == len(places) == len(turns) or len(times_s) < 2 or (np.diff(times_s) <= 0).any():
        raise RecordingError(f"{folder / POSES_FOLDER}: it takes a place and an orientation for each time")
    film = FilmReader(folder / FILM, times_s)
    source = _source(times_s, places, turns)
    # A segment's folder is called after its number, the folder it lies in after its route.
    name = "--".join(folder.resolve().parts[-2:]).replace("|", "_")
    eyes = tuple(OneCamera(spec, source, film) for spec in specs)
    return Recording(name, times_s, poses_of(times_s, places, turns), eyes)


def poses_of(times_s: Array, places: Array, turns: Array) -> Array:
    """The car's poses [n, 4], x east, y north, z up from where it begins, heading from east, unwrapped.

    Args:
        times_s: [n].
        places: of the camera, [n, 3], ECEF in m.
        turns: of the camera's axes to ECEF, [n, 3, 3].
    """
    to_local = east_north_up(places[0])
    local = (places - places[0]) @ to_local.T
    forward = turns[:, :, 0] @ to_local.T
    heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    step = np.diff(local, axis=0)
    moving = np.linalg.norm(step, axis=1) > _MOVING_MPS * np.diff(times_s)
    if moving.any():
        course = np.arctan2(step[:, 1], step[:, 0])
        beside = np.angle(np.exp(1j * (course - heading[:-1])))
        heading = heading + np.median(beside[moving])  # the camera looks a little to the side
    return np.concatenate([local, heading[:, None]], axis=1)


def east_north_up(place: Array) -> Array:
    """Rows: east, north and up at an ECEF place on the ground. Up is the normal of the WGS 84 ellipsoid."""
    up = place / _WGS84_SEMI_AXES_M**2
    up /= np.linalg.norm(up)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def _source(times_s: Array, places: Array, turns: Array) -> Source:
    """The camera: where the car goes is where the horizon and straight ahead lie in its pictures."""
    velocity = np.diff(places, axis=0) / np.diff(times_s)[:, None]
    seen = np.einsum("nij,ni->nj", turns[:-1], velocity)
    seen = seen[seen[:, 0] > _MOVING_MPS]
    right, down = np.median(seen[:, 1:] / seen[:, :1], axis=0) if len(seen) else (0.0, 0.0)
    return Source(
        FILM,
        fov_of(WIDTH_PX, FOCAL_PX),
        horizon=float(np.clip(0.5 + FOCAL_PX * down / HEIGHT_PX, 0, 1)),
        ahead=float(np.clip(0.5 + FOCAL_PX * right / WIDTH_PX, 0, 1)),
    )


def _array(folder: Path, name: str, shape: tuple[int, ...]) -> Array:
    path = folder / POSES_FOLDER / name
    try:
        found = np.asarray(np.load(path, allow_pickle=False), np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    if found.shape[1:] != shape or not np.isfinite(found).all():
        raise RecordingError(f"{path}: it takes finite numbers, [n{''.join(f', {k}' for k in shape)}]")
    return found
