from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from looktwice.clients.importers.comma2k19 import read_segments
from looktwice.clients.importers.recording import RecordingError
from looktwice.clients.importers.resampling import OneCamera
from looktwice.model.driving.cameras import FRONT_CAMERAS
from looktwice.model.driving.images import decode_image
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import present_speed
from looktwice.service.cli.commands import app
from tests.comma2k19 import SEGMENT

WIDE, TELE = (spec.resized(336) for spec in FRONT_CAMERAS)


def test_the_minute_becomes_scenes(tmp_path: Path) -> None:
    out = tmp_path / "scenes.parquet"
    result = CliRunner().invoke(
        app, ["scenes", "import", str(SEGMENT), str(out), "--route", "--stride", "10"]
    )
    assert result.exit_code == 0, result.output
    assert "6 scenes" in result.output
    assert "80% of what the model gets is grey" in result.output
    scenes = list(read_scenes(out))
    assert scenes[0].scene.scene_id.startswith("comma2k19--segment_40-")
    bus = SEGMENT / "processed_log" / "CAN" / "speed"
    for labelled in scenes:
        now_s = float(labelled.scene.scene_id.rsplit("-", 1)[1])
        wheels = float(np.interp(now_s, np.load(bus / "t"), np.load(bus / "value")[:, 0]))
        assert present_speed(labelled.scene.history) == pytest.approx(wheels, abs=0.6)
        assert abs(labelled.future[9, 1]) < 0.3, "the road is straight"
    assert scenes[0].scene.route is not None


def test_where_the_car_goes_is_where_the_road_meets_the_sky() -> None:
    """Read off the frame: its lane lines meet at about column 595 and row 388, of 1164 by 874."""
    (minute,) = read_segments(SEGMENT, (TELE,))
    (eye,) = minute.eyes
    assert isinstance(eye, OneCamera)
    assert eye.source.ahead * 1164 == pytest.approx(595, abs=10)
    assert eye.source.horizon * 874 == pytest.approx(388, abs=15)
    encoded = eye.at(float(minute.times_s[0]))
    assert encoded is not None
    middle = decode_image(encoded)[:, 148:188].astype(int)
    horizon = round(TELE.horizon * TELE.height)
    assert middle[: horizon - 50].mean() > middle[horizon + 50 :].mean() + 10, (
        "the sky is lighter than the road"
    )


def test_a_film_may_be_looked_at_backwards() -> None:
    (minute,) = read_segments(SEGMENT, (TELE,))
    times_s = minute.times_s
    later = minute.eyes[0].at(float(times_s[60]))
    assert minute.eyes[0].at(float(times_s[0])) is not None
    assert later == minute.eyes[0].at(float(times_s[60]))
    assert minute.eyes[0].at(float(times_s[0]) - 1) is None


def test_segments_of_a_route_are_named_after_it(tmp_path: Path) -> None:
    route = tmp_path / "Chunk_1" / "b0c9d2329ad1606b|2018-07-27--06-03-57"
    for number in ("3", "4"):
        shutil.copytree(SEGMENT / "global_pose", route / number / "global_pose")
    names = [segment.name for segment in read_segments(tmp_path, (TELE,))]
    assert names == [f"b0c9d2329ad1606b_2018-07-27--06-03-57--{number}" for number in ("3", "4")]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("no poses", "has no global_pose"),
        ("no times", "frame_times cannot be read"),
        ("no array", "frame_positions cannot be read"),
        ("shape", r"frame_orientations: it takes finite numbers, \[n, 4\]"),
        ("length", "a place and an orientation for each time"),
        ("no film", "video.hevc is missing"),
        ("short film", "ends after 0 pictures"),
    ],
)
def test_what_is_no_segment_is_told(tmp_path: Path, change: str, reason: str) -> None:
    folder = tmp_path / "0"
    poses = folder / "global_pose"
    folder.mkdir()
    if change != "no poses":
        shutil.copytree(SEGMENT / "global_pose", poses)
    if change == "no times":
        (poses / "frame_times").unlink()
    elif change == "no array":
        (poses / "frame_positions").write_bytes(b"no array")
    elif change == "shape":
        shutil.copy(poses / "frame_positions", poses / "frame_orientations")
    elif change == "length":
        with (poses / "frame_times").open("wb") as file:
            np.save(file, np.arange(3.0))
    elif change == "short film":
        (folder / "video.hevc").write_bytes(b"")
    with pytest.raises(RecordingError, match=reason):
        [list(minute.scenes()) for minute in read_segments(folder, (TELE,))]
