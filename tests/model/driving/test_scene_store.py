from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from looktwice.model.driving.lane_map import LaneArea, LaneMap
from looktwice.model.driving.scene import FRONT_WIDE, DenseTarget, LabelledScene, NextFrame, SceneError
from looktwice.model.driving.scene_store import (
    ROW_GROUP,
    SCENE_VERSION,
    SceneFileError,
    count_scenes,
    read_scenes,
    write_scenes,
)
from tests.model.driving.drives import agent, labelled_scene, rectangle


def assert_same(one: Any, other: Any, where: str = "scene") -> None:
    """Equality of nested dataclasses with arrays; types count, NaN equals NaN."""
    assert type(one) is type(other), where
    if is_dataclass(one):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name), f"{where}.{field.name}")
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype, where
        np.testing.assert_array_equal(one, other, where)
    elif isinstance(one, tuple):
        assert len(one) == len(other), where
        for index, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}[{index}]")
    elif isinstance(one, float):
        assert one == pytest.approx(other), where
    else:
        assert one == other, where


def rich_scene() -> LabelledScene:
    """A scene that uses every field."""
    gone = agent(x=8, y=-3, kind="pedestrian", agent_id=2, size_m=(0.5, 0.5, 1.75))
    poses = gone.poses.copy()
    poses[40:] = np.nan
    classes = np.arange(48, dtype=np.uint8).reshape(6, 8) % 6
    return replace(
        labelled_scene(9.0, 0.1, agents=(agent(15, 0), replace(gone, poses=poses)), pictures=3),
        drivable=(rectangle(-50, -6, 90, 6), rectangle(3, 3, 4, 4)),
        tags=frozenset({"pedestrian", "turn"}),
        dense=(DenseTarget(FRONT_WIDE, classes, np.zeros((6, 8), np.float32)),),
        lane_map=LaneMap(
            (
                LaneArea(3, rectangle(-50.004, -1.75, 90.123, 1.75), True),
                LaneArea(4, rectangle(-50, 1.75, 90, 5.25), False),
            ),
            (rectangle(20, -6, 40, 6), rectangle(28, -1, 30, 1)),
            np.array([[-20.0, 0.01], [160.0, -0.02]]),
            has_lights=False,
        ),
        next_frames=(NextFrame("back_left", b"left"), NextFrame(FRONT_WIDE, b"wide")),
    )


def bare_scene() -> LabelledScene:
    """A scene with nothing that may be left out."""
    scene = labelled_scene(scene_id="bare")
    return LabelledScene(replace(scene.scene, route=None), "other", 7, scene.future)


def test_everything_a_scene_knows_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "scenes.parquet"
    written = [rich_scene(), bare_scene()]
    assert write_scenes(path, written) == 2
    for one, other in zip(written, read_scenes(path), strict=True):
        assert_same(one, other)


def test_files_without_next_frames_are_what_they_always_were(tmp_path: Path) -> None:
    path = tmp_path / "scenes.parquet"
    write_scenes(path, [bare_scene()])
    assert "next_frames" not in pq.read_schema(path).names
    write_scenes(path, [rich_scene(), bare_scene()])
    told = {name: [scene.next_frames for scene in read_scenes(path, dense=name)] for name in (True, False)}
    assert told[True] == told[False] == [rich_scene().next_frames, ()]


def test_next_frames_behind_a_scene_without_any_are_not_lost_in_silence(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="next frames, and the first of its file has none"):
        write_scenes(tmp_path / "scenes.parquet", [bare_scene(), rich_scene()])
    assert not list(tmp_path.iterdir())
    with pytest.raises(SceneError, match="two next frames"):
        replace(bare_scene(), next_frames=(NextFrame("back", b"1"), NextFrame("back", b"2")))
    with pytest.raises(SceneError, match="unknown camera 'rear'"):
        NextFrame("rear", b"")


def test_files_from_before_lane_maps_are_read(tmp_path: Path) -> None:
    path = tmp_path / "old.parquet"
    write_scenes(path, [rich_scene()])
    old = pq.read_table(path)
    pq.write_table(old.drop_columns(["lane_map"]), path)
    for dense in (True, False):
        (read,) = read_scenes(path, dense=dense)
        assert_same(read, replace(rich_scene(), lane_map=None, dense=rich_scene().dense if dense else ()))
    assert old.num_rows == count_scenes(path)


def test_a_broken_lane_map_says_so(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    write_scenes(path, [rich_scene()])
    table = pq.read_table(path)
    row = table.to_pylist()[0]
    row["lane_map"]["lanes"][0]["ring"] = [0, 0, 100, 0]
    pq.write_table(pa.Table.from_pylist([row], schema=table.schema), path)
    with pytest.raises(SceneFileError, match=r"no scene: lane 3 needs at least 3 points"):
        list(read_scenes(path))


def test_ranges_of_dense_targets_are_off_by_little(tmp_path: Path) -> None:
    range_m = np.array([[0.0, 0.5, 3.0, 12.0], [50.0, 180.0, 400.0, 900.0]], np.float32)
    target = DenseTarget(FRONT_WIDE, np.zeros((2, 4), np.uint8), range_m)
    write_scenes(tmp_path / "s.parquet", [replace(rich_scene(), dense=(target,))])
    (read,) = read_scenes(tmp_path / "s.parquet")
    back = read.dense[0].range_m
    assert back[0, 0] == 0.0
    np.testing.assert_allclose(1 + back.ravel()[:-1], 1 + range_m.ravel()[:-1], rtol=0.0125)
    assert back[1, 3] == pytest.approx(400, rel=1e-3)  # farther is not told apart


def test_dense_targets_are_left_out_on_request(tmp_path: Path) -> None:
    write_scenes(tmp_path / "s.parquet", [rich_scene()])
    (read,) = read_scenes(tmp_path / "s.parquet", dense=False)
    assert read.dense == ()
    assert len(read.agents) == 2


def test_row_groups_are_small_and_counts_come_from_the_footer(tmp_path: Path) -> None:
    path = tmp_path / "many.parquet"
    assert write_scenes(path, (bare_scene() for _ in range(ROW_GROUP + 2)), {"seeds": "7"}) == ROW_GROUP + 2
    assert pq.ParquetFile(path).num_row_groups == 2
    assert pq.read_schema(path).metadata[b"seeds"] == b"7"
    assert count_scenes(path) == ROW_GROUP + 2


def test_a_folder_is_read_file_by_file(tmp_path: Path) -> None:
    for name in ("b", "a"):
        scene = bare_scene()
        write_scenes(
            tmp_path / f"{name}.parquet", [replace(scene, scene=replace(scene.scene, scene_id=name))]
        )
    (tmp_path / ".c.parquet.99.tmp").write_bytes(b"half")  # what a killed writer leaves
    assert [scene.scene.scene_id for scene in read_scenes(tmp_path)] == ["a", "b"]
    assert count_scenes(tmp_path) == 2


def refused(path: Path, message: str) -> None:
    for use in (lambda: list(read_scenes(path)), lambda: count_scenes(path)):
        with pytest.raises(SceneFileError, match=message):
            use()


def test_what_is_no_scene_file_says_so(tmp_path: Path) -> None:
    refused(tmp_path / "missing.parquet", "does not exist")
    refused(tmp_path, r"holds no \.parquet scene files")
    text = tmp_path / "text.parquet"
    text.write_text("not parquet at all, but long enough to have a footer")
    refused(text, "not a whole Parquet file")
    other = tmp_path / "other.parquet"
    pq.write_table(pa.table({"x": [1]}), other)
    refused(other, "holds no LookTwice scenes")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_file_says_so(tmp_path: Path, share: float) -> None:
    path = tmp_path / "s.parquet"
    write_scenes(path, [rich_scene()])
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    refused(path, "not a whole Parquet file")


def test_another_version_says_so(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    write_scenes(path, [bare_scene()])
    table = pq.read_table(path)
    metadata = {**table.schema.metadata, b"looktwice.scene_version": b"99"}
    pq.write_table(table.replace_schema_metadata(metadata), path)
    refused(path, f"scene version 99, this LookTwice reads version {SCENE_VERSION}")


def test_flipped_bits_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    write_scenes(path, [rich_scene()])
    content = bytearray(path.read_bytes())
    picture = rich_scene().scene.clips[0].images[1]
    place = content.index(picture[200:240])  # JPEG bytes do not compress: they stand in the file as they are
    content[place] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(SceneFileError, match="damaged"):
        list(read_scenes(path))


def test_a_row_that_is_no_scene_says_so(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    write_scenes(path, [bare_scene()])
    table = pq.read_table(path)
    row = table.to_pylist()[0] | {"history": [0.0] * 60}
    pq.write_table(pa.Table.from_pylist([row], schema=table.schema), path)
    with pytest.raises(SceneFileError, match=r"no scene: history must have shape \[16, 4\], got \[15, 4\]"):
        list(read_scenes(path))


def failing() -> Iterator[LabelledScene]:
    yield rich_scene()
    raise RuntimeError("the simulator died")


def test_a_failing_source_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    write_scenes(path, [bare_scene()])
    with pytest.raises(RuntimeError, match="simulator died"):
        write_scenes(path, failing())
    assert [scene.scene.scene_id for scene in read_scenes(path)] == ["bare"]
    assert list(tmp_path.iterdir()) == [path]


KILLED_WRITER = """
import os, signal, sys
from pathlib import Path
from looktwice.model.driving.scene_store import ROW_GROUP, write_scenes
from tests.model.driving.drives import labelled_scene

def scenes():
    for _ in range(ROW_GROUP + 1):
        yield labelled_scene(scene_id="half")
    os.kill(os.getpid(), signal.SIGKILL)

write_scenes(Path(sys.argv[1]), scenes())
"""


def test_a_writer_killed_in_the_middle_leaves_the_old_file_whole(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    write_scenes(path, [bare_scene()])
    root = Path(__file__).parents[3]
    killed = subprocess.run([sys.executable, "-c", KILLED_WRITER, str(path)], cwd=root, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 2  # it did write something
    assert [scene.scene.scene_id for scene in read_scenes(tmp_path)] == ["bare"]
    write_scenes(path, [rich_scene()])
    assert [scene.scene.scene_id for scene in read_scenes(tmp_path)] == ["scene"]
