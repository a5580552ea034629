"""Followed trajectories come back as they were written; whatever is no such file is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from looktwice.model.driving.followed_store import (
    FollowedFileError,
    FollowedTrajectory,
    read_followed,
    write_followed,
)
from looktwice.model.driving.outcome import VERDICTS


def some(count: int) -> list[FollowedTrajectory]:
    random = np.random.default_rng(0)
    return [
        FollowedTrajectory(
            f"{number:06d}-0015",
            random.normal(size=(64, 4)).astype(np.float32),
            "brake" if number % 2 else "",
            VERDICTS[number % len(VERDICTS)],
            "teacher 0123456789ab",
        )
        for number in range(count)
    ]


def test_they_come_back_as_they_were_written(tmp_path: Path) -> None:
    written = some(9)
    assert write_followed(tmp_path / "deep" / "followed.parquet", written) == 9
    again = list(read_followed(tmp_path / "deep" / "followed.parquet"))
    for one, other in zip(written, again, strict=True):
        np.testing.assert_array_equal(one.trajectory, other.trajectory)
        assert vars(one) | {"trajectory": None} == vars(other) | {"trajectory": None}


def test_half_a_file_and_another_version_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "followed.parquet"
    write_followed(path, some(3))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(FollowedFileError, match="not a whole Parquet file"):
        list(read_followed(path))
    pq.write_table(pa.table({"scene_id": ["a"]}), path)
    with pytest.raises(FollowedFileError, match="version 1"):
        list(read_followed(path))


@pytest.mark.parametrize(("column", "value"), [("verdict", "explodes"), ("mend", "fly")])
def test_a_row_that_says_something_else_is_refused(tmp_path: Path, column: str, value: str) -> None:
    path = tmp_path / "followed.parquet"
    write_followed(path, some(3))
    table = pq.read_table(path)
    rows = table.to_pylist()
    rows[1][column] = value
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), path)
    with pytest.raises(FollowedFileError, match=value):
        list(read_followed(path))


def test_a_trajectory_without_an_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "followed.parquet"
    broken = some(2)
    broken[1].trajectory[5, 0] = np.nan
    write_followed(path, broken)
    with pytest.raises(FollowedFileError, match="not finite"):
        list(read_followed(path))
