"""Scenes from a drive of one's own: a folder with pictures and poses, seen as our cameras would see it.

A recording is a folder with ``poses.csv`` (columns ``time_s``, ``x_m``, ``y_m``, ``heading_rad`` and, where
it is known, ``z_m``; any frame that is fixed to the world, headings counter-clockwise from x) and a folder
of pictures for each camera, named after their times in seconds, such as ``12.345.jpg``.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from model.driving.cameras import CameraSpec
from model.driving.images import ImageError, decode_image, encode_jpeg
from model.driving.scene import CLIP_FRAMES, CLIP_PERIOD_S, Clip, LabelledScene, Scene
from model.driving.trajectory import (
    FUTURE_STEPS,
    HISTORY_STEPS,
    ROUTE_POINTS,
    ROUTE_SPACING_M,
    STEP_S,
    FloatArray,
    to_ego_frame,
)

POSES_FILE: Final = "poses.csv"
_COLUMNS: Final = ("time_s", "x_m", "y_m", "heading_rad")
_TABLE: Final = ("time_s", "x_m", "y_m", "z_m", "heading_rad")
_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp")
_MOST_APART_S: Final = 0.06
"""Between a moment and the picture that stands for it."""
_LONGEST_GAP_S: Final = 0.25
"""Between poses: over more nobody knows how the car moved."""
_GREY: Final = (128, 128, 128)
_MUCH_GREY: Final = 0.1
_QUALITY: Final = 92

Array = npt.NDArray[np.float64]


class RecordingError(ValueError):
    """A folder that is no recording; the text says what is missing."""


@dataclass(frozen=True)
class Source:
    """Where the pictures of a camera come from.

    Attributes:
        folder: of the pictures, within the recording.
        hfov_degrees: what they show from side to side.
        horizon: where the horizon lies in them, as a share of their height from the top.
    """

    folder: str
    hfov_degrees: float
    horizon: float = 0.5

    def __post_init__(self) -> None:
        if not 1 <= self.hfov_degrees < 170:
            raise RecordingError(f"{self.folder}: a field of view of {self.hfov_degrees:g} degrees is none")
        if not 0 <= self.horizon <= 1:
            raise RecordingError(f"{self.folder}: the horizon is a share of the height, from 0 to 1")


@dataclass(frozen=True, eq=False)
class Recording:
    """A drive.

    Attributes:
        name: of its folder.
        times_s: [n], ascending.
        poses: [n, 4], x, y, z in m and heading in rad, unwrapped.
        pictures: of each source's folder the times and files, in order of time.
    """

    name: str
    times_s: Array
    poses: Array
    pictures: Mapping[str, tuple[Array, Sequence[Path]]]

    @classmethod
    def read(cls, folder: Path, sources: Sequence[Source]) -> Recording:
        """Read a folder; raises `RecordingError` for one that is none."""
        times_s, poses = _read_poses(folder / POSES_FILE)
        pictures = {source.folder: _pictures(folder / source.folder) for source in sources}
        return cls(folder.resolve().name, times_s, poses, pictures)

    def at(self, times_s: Array) -> Array:
        """Poses [k, 4] at times within the recording, between those that are known."""
        return np.stack([np.interp(times_s, self.times_s, column) for column in self.poses.T], axis=1)

    def scenes(
        self, cameras: Mapping[CameraSpec, Source], *, stride_s: float = 0.5, route: bool = False
    ) -> Iterator[LabelledScene]:
        """A scene every so often, wherever there are pictures, 1.5 s of past and 6.4 s of future.

        Args:
            cameras: how each camera is played.
            stride_s: seconds from scene to scene.
            route: take the way that was driven for the route, where 80 m of it are known.
        """
        first_s, last_s = self.times_s[0], self.times_s[-1]
        now_s = first_s + (HISTORY_STEPS - 1) * STEP_S
        while now_s + FUTURE_STEPS * STEP_S <= last_s:
            if (scene := self._scene(now_s, cameras, route=route)) is not None:
                yield scene
            now_s += stride_s

    def _scene(
        self, now_s: float, cameras: Mapping[CameraSpec, Source], *, route: bool
    ) -> LabelledScene | None:
        if not self._is_known(now_s - (HISTORY_STEPS - 1) * STEP_S, now_s + FUTURE_STEPS * STEP_S):
            return None
        clips = []
        for spec, source in cameras.items():
            moments = now_s + CLIP_PERIOD_S * np.arange(1 - CLIP_FRAMES, 1)
            files = [self._nearest(source.folder, float(moment)) for moment in moments]
            if None in files:
                return None
            clips.append(Clip(spec.name, tuple(played(spec, source, file) for file in files if file)))
        steps = np.arange(1 - HISTORY_STEPS, FUTURE_STEPS + 1)
        world = self.at(np.asarray(now_s + STEP_S * steps, np.float64))
        seen = to_ego_frame(world, world[HISTORY_STEPS - 1]).astype(np.float32)
        way = self._way(now_s) if route else None
        scene = Scene(f"{self.name}-{now_s:.2f}", tuple(clips), seen[:HISTORY_STEPS], way)
        return LabelledScene(scene, self.name, seed=0, future=seen[HISTORY_STEPS:])

    def _is_known(self, begin_s: float, end_s: float) -> bool:
        inside = self.times_s[(self.times_s > begin_s) & (self.times_s < end_s)]
        return bool(np.diff([begin_s, *inside, end_s]).max() <= _LONGEST_GAP_S)

    def _nearest(self, folder: str, moment_s: float) -> Path | None:
        times_s, files = self.pictures[folder]
        number = int(np.abs(times_s - moment_s).argmin())
        return files[number] if abs(times_s[number] - moment_s) <= _MOST_APART_S else None

    def _way(self, now_s: float) -> FloatArray | None:
        """Points every 4 m along what was driven from now on, in the ego frame; None where it ends before."""
        ahead = self.at(np.concatenate([[now_s], self.times_s[self.times_s > now_s]]))
        driven = to_ego_frame(ahead, ahead[0])[:, :2]
        along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(driven, axis=0), axis=1))])
        wanted_m = ROUTE_SPACING_M * np.arange(1, ROUTE_POINTS + 1)
        if along_m[-1] < wanted_m[-1]:
            return None
        return np.stack([np.interp(wanted_m, along_m, column) for column in driven.T], 1).astype(np.float32)


def played(spec: CameraSpec, source: Source, file: Path) -> bytes:
    """A picture as ``spec`` would have taken it, as JPEG: what it does not show is grey.

    Raises:
        RecordingError: a file that is no picture.
    """
    try:
        picture = Image.fromarray(decode_image(file.read_bytes()))
    except ImageError as error:
        raise RecordingError(f"{file}: {error}") from error
    left, top, right, bottom = _box(spec, source, picture.size)
    before_x, before_y = max(0, int(np.ceil(-left))), max(0, int(np.ceil(-top)))
    size = (
        before_x + max(picture.width, int(np.ceil(right))),
        before_y + max(picture.height, int(np.ceil(bottom))),
    )
    canvas = Image.new("RGB", size, _GREY)
    canvas.paste(picture, (before_x, before_y))
    box = (left + before_x, top + before_y, right + before_x, bottom + before_y)
    seen = canvas.resize((spec.width, spec.height), Image.Resampling.LANCZOS, box)
    return encode_jpeg(np.asarray(seen, np.uint8), _QUALITY)


def grey_share(spec: CameraSpec, source: Source, size: tuple[int, int]) -> float:
    """How much of what ``spec`` sees is not on pictures of that size, 0 to 1."""
    left, top, right, bottom = _box(spec, source, size)
    width = min(right, size[0]) - max(left, 0.0)
    height = min(bottom, size[1]) - max(top, 0.0)
    return 1.0 - max(0.0, width) * max(0.0, height) / ((right - left) * (bottom - top))


def doubts(recording: Recording, cameras: Mapping[CameraSpec, Source]) -> list[str]:
    """What makes a recording unlike what our cameras see, for people; none for one that is like it."""
    told = []
    for spec, source in cameras.items():
        with Image.open(recording.pictures[source.folder][1][0]) as picture:
            grey = grey_share(spec, source, picture.size)
        if grey > _MUCH_GREY:
            told.append(
                f"{spec.name} sees {spec.hfov_degrees:g} degrees, the pictures in {source.folder} "
                f"{source.hfov_degrees:g}: {grey:.0%} of what the model gets is grey"
            )
    return told


def _box(spec: CameraSpec, source: Source, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of what ``spec`` sees, in pixels of pictures of that size."""
    width, height = size
    focal_px = width / 2 / np.tan(np.radians(source.hfov_degrees) / 2)
    scale = focal_px / spec.focal_px
    left = width / 2 - scale * spec.width / 2
    top = source.horizon * height - scale * spec.horizon * spec.height
    return left, top, left + scale * spec.width, top + scale * spec.height


def _read_poses(path: Path) -> tuple[Array, Array]:
    if not path.is_file():
        raise RecordingError(f"{path} is missing: a row a pose, with columns {', '.join(_COLUMNS)}")
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file)
        if missing := [name for name in _COLUMNS if name not in (rows.fieldnames or ())]:
            raise RecordingError(f"{path} lacks the column {', '.join(missing)}")
        try:
            table = np.array([[_number(row, name) for name in _TABLE] for row in rows], np.float64)
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{path}, line {rows.line_num}: {error}") from None
    if len(table) < 2 or not np.isfinite(table).all():
        raise RecordingError(f"{path} needs two poses at least, and finite numbers")
    if (np.diff(table[:, 0]) <= 0).any():
        raise RecordingError(f"{path}: times must ascend")
    poses = table[:, 1:]
    poses[:, 3] = np.unwrap(poses[:, 3])
    return table[:, 0], poses


def _number(row: Mapping[str, str | None], name: str) -> float:
    given = row.get(name)
    if not given and name not in _COLUMNS:
        return 0.0  # heights are rarely known
    return float(given or "")


def _pictures(folder: Path) -> tuple[Array, list[Path]]:
    if not folder.is_dir():
        raise RecordingError(f"there is no folder {folder}; name where a camera's pictures are")
    found = []
    for file in folder.iterdir():
        if file.suffix.lower() in _SUFFIXES:
            try:
                found.append((float(file.stem), file))
            except ValueError:
                raise RecordingError(f"{file} is not named after its time in s, as 12.345.jpg is") from None
    if not found:
        raise RecordingError(f"there are no pictures in {folder}")
    found.sort()
    return np.array([time_s for time_s, _ in found]), [file for _, file in found]
