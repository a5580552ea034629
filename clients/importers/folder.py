"""The plainest recording: a table of poses, and a folder of pictures for each camera.

``poses.csv`` has columns ``time_s``, ``x_m``, ``y_m``, ``heading_rad`` and, where it is known, ``z_m``; any
frame that is fixed to the world will do, with headings counter-clockwise from x. Pictures are named after
their times in seconds, such as ``12.345.jpg``.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from looktwice.clients.importers.recording import Array, Recording, RecordingError
from looktwice.clients.importers.resampling import OneCamera, PictureFiles, Source
from looktwice.model.driving.cameras import CameraSpec

POSES_FILE: Final = "poses.csv"
_COLUMNS: Final = ("time_s", "x_m", "y_m", "heading_rad")
_TABLE: Final = ("time_s", "x_m", "y_m", "z_m", "heading_rad")
_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp")


def read_folder(folder: Path, cameras: Mapping[CameraSpec, Source]) -> Recording:
    """Read a folder; raises `RecordingError` for one that is none.

    Args:
        folder: with the table and the folders of pictures.
        cameras: what stands for each of the model's cameras; sources are named like their folders.
    """
    times_s, poses = _read_poses(folder / POSES_FILE)
    eyes = tuple(OneCamera(spec, source, _pictures(folder / source.name)) for spec, source in cameras.items())
    return Recording(folder.resolve().name, times_s, poses, eyes)


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


def _pictures(folder: Path) -> PictureFiles:
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
    return PictureFiles(np.array([time_s for time_s, _ in found]), [file for _, file in found])
