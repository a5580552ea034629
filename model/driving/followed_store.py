"""Trajectories that were followed in the simulator, in Parquet files: what a critic learns from.

A file carries ``looktwice.followed_version`` in its metadata; readers refuse other versions. It is written to
a temporary name beside its place and renamed, so a reader never meets half a file.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import pyarrow as pa

from looktwice.model.driving.mends import Alternative
from looktwice.model.driving.outcome import VERDICTS, Verdict
from looktwice.model.driving.parquet_rows import read_rows, write_rows
from looktwice.model.driving.trajectory import FUTURE_STEPS, FloatArray

FOLLOWED_VERSION: Final = "1"
_VERSION_KEY: Final = b"looktwice.followed_version"
_ROW_GROUP: Final = 4096
Led = Alternative | Literal[""]
"""What led to a trajectory from the planner's own; empty for that one."""


class FollowedFileError(ValueError):
    """A file of followed trajectories that is missing, damaged, of another version, or holds no such row."""


@dataclass(frozen=True, eq=False)
class FollowedTrajectory:
    """A trajectory from a scene's moment, and what came of it.

    Attributes:
        scene_id: of a scene in the scene store.
        trajectory: float32 [64, 4], in the ego frame of the scene.
        mend: see `Led`.
        verdict: see `VERDICTS`.
        planner: name and revision of who planned.
    """

    scene_id: str
    trajectory: FloatArray
    mend: Led
    verdict: Verdict
    planner: str


_LED: Final = {"", *(name for kind in get_args(Alternative) for name in get_args(kind) or (kind,))}
_SCHEMA: Final = pa.schema(
    [
        ("scene_id", pa.string()),
        ("trajectory", pa.binary(FUTURE_STEPS * 4 * 4)),
        *((name, pa.string()) for name in ("mend", "verdict", "planner")),
    ]
)


def write_followed(path: Path, followed: Iterable[FollowedTrajectory]) -> int:
    """Write trajectories to one file and return how many there were; see the module's first lines."""
    schema = _SCHEMA.with_metadata({_VERSION_KEY: FOLLOWED_VERSION.encode()})
    return write_rows(path, map(_to_row, followed), schema, _ROW_GROUP)


def read_followed(path: Path) -> Iterator[FollowedTrajectory]:
    """Yield the trajectories of a file.

    Raises:
        FollowedFileError: see the class.
    """
    what = "followed trajectories"
    for row in read_rows(path, _VERSION_KEY, FOLLOWED_VERSION, what, FollowedFileError):
        trajectory = np.frombuffer(row["trajectory"], "<f4").reshape(FUTURE_STEPS, 4)
        if row["verdict"] not in VERDICTS or row["mend"] not in _LED:
            raise FollowedFileError(
                f"{path} holds a row that is none: verdict {row['verdict']!r}, mend {row['mend']!r}"
            )
        if not np.isfinite(trajectory).all():
            raise FollowedFileError(f"{path} holds a trajectory of {row['scene_id']} that is not finite")
        yield FollowedTrajectory(**(row | {"trajectory": trajectory.astype(np.float32)}))


def _to_row(followed: FollowedTrajectory) -> dict[str, Any]:
    return vars(followed) | {"trajectory": followed.trajectory.astype("<f4").tobytes()}
