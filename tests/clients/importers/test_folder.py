from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from looktwice.clients.importers.folder import read_folder
from looktwice.clients.importers.recording import RecordingError
from looktwice.clients.importers.resampling import Source, as_seen, fov_of, grey_share
from looktwice.model.driving.cameras import FRONT_CAMERAS
from looktwice.model.driving.images import decode_image
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import present_speed
from looktwice.service.cli.commands import app

WIDE, TELE = (spec.resized(336) for spec in FRONT_CAMERAS)
SPEED_MS, TURN_RADS = 12.0, 0.1
BOTH = ["--camera", "front_wide_120=dash:100:0.45", "--camera", "front_tele_30=dash:100:0.45"]


def picture(width: int, height: int, hfov_degrees: float, horizon: float) -> Image.Image:
    """Red tells the angle to the left of straight ahead, in degrees and 128; blue is sky, green is road."""
    focal_px = width / 2 / math.tan(math.radians(hfov_degrees) / 2)
    columns = np.degrees(np.arctan2(width / 2 - (np.arange(width) + 0.5), focal_px))
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[..., 0] = np.clip(128 + columns, 0, 255)
    sky = round(horizon * height)
    pixels[:sky, :, 2] = 255
    pixels[sky:, :, 1] = 255
    return Image.fromarray(pixels)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 s round a bend, poses at 20 Hz in a frame of somewhere, pictures at 10 Hz from one camera."""
    folder = tmp_path_factory.mktemp("drive")
    with (folder / "poses.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["heading_rad", "time_s", "x_m", "y_m"])
        for step in range(241):
            time_s = 100 + step / 20
            turned = TURN_RADS * step / 20
            heading = (3.0 + turned + math.pi) % (2 * math.pi) - math.pi  # wraps on the way
            radius = SPEED_MS / TURN_RADS
            x = 500 + radius * (math.sin(3 + turned) - math.sin(3))
            y = -200 - radius * (math.cos(3 + turned) - math.cos(3))
            rows.writerow([heading, time_s, x, y])
    (folder / "dash").mkdir()
    shown = picture(800, 600, 100, 0.45)
    for step in range(120):
        shown.save(folder / "dash" / f"{100.01 + step / 10:.3f}.jpg", quality=95)
    return folder


def ran(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["scenes", "import", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


def test_a_drive_becomes_scenes_that_move_as_it_did(drive: Path, tmp_path: Path) -> None:
    told = ran(drive, tmp_path / "scenes.parquet", *BOTH, "--route", "--stride", 1)
    assert "5 scenes" in told
    scenes = list(read_scenes(tmp_path / "scenes.parquet"))
    assert len(scenes) == 5
    for labelled in scenes:
        assert present_speed(labelled.scene.history) == pytest.approx(SPEED_MS, abs=0.05)
        turned_rad = 6.4 * TURN_RADS
        radius_m = SPEED_MS / TURN_RADS
        x, y, z, heading = labelled.future[-1]
        assert (x, y) == pytest.approx(
            (radius_m * math.sin(turned_rad), radius_m * (1 - math.cos(turned_rad))), abs=0.2
        )
        assert (z, heading) == pytest.approx((0, turned_rad), abs=0.01)
        assert [clip.camera for clip in labelled.scene.clips] == ["front_wide_120", "front_tele_30"]
    assert scenes[0].scene.route is not None
    assert scenes[-1].scene.route is None, "its end is too near for 80 m of route"
    steps = np.linalg.norm(np.diff(scenes[0].scene.route, axis=0), axis=1)
    np.testing.assert_allclose(steps, 4.0, atol=0.02)


@pytest.mark.parametrize("spec", [WIDE, TELE], ids=lambda spec: str(spec.name))
@pytest.mark.parametrize(("hfov", "horizon"), [(100.0, 0.45), (150.0, 0.5)])
def test_a_picture_is_played_as_the_camera_would_have_taken_it(
    spec: object, hfov: float, horizon: float
) -> None:
    assert spec in (WIDE, TELE)
    camera = WIDE if spec is WIDE else TELE
    shown = np.asarray(picture(1600, 1200, hfov, horizon))
    seen = decode_image(as_seen(camera, Source("dash", hfov, horizon), shown)).astype(float)
    assert seen.shape == (168, 336, 3)
    columns = np.degrees(np.arctan2(168 - (np.arange(336) + 0.5), camera.focal_px))
    row = seen[round(camera.horizon * 168) + 8]
    shown = np.abs(columns) < hfov / 2 - 6
    np.testing.assert_allclose(row[shown, 0] - 128, columns[shown], atol=4)
    assert (np.abs(row[np.abs(columns) > hfov / 2 + 6] - 128) < 12).all(), "what nobody saw is grey"
    middle = seen[:, 168]
    assert middle[round(camera.horizon * 168) - 6, 2] > 200
    assert middle[round(camera.horizon * 168) + 6, 1] > 200


def test_what_is_unlike_our_cameras_is_told(drive: Path) -> None:
    recording = read_folder(drive, {WIDE: Source("dash", 60.0), TELE: Source("dash", 60.0)})
    (doubt,) = recording.doubts()
    assert "front_wide_120" in doubt
    assert "60" in doubt
    assert grey_share(TELE, Source("dash", 60.0), (800, 600)) == 0


def test_stretched_pictures_are_told_and_made_even(tmp_path: Path) -> None:
    """800 by 600 pixels of square ones, squeezed to half their height."""
    even = picture(800, 600, 100, 0.45)
    squeezed = even.resize((800, 300), Image.Resampling.BOX)
    down_degrees = fov_of(600, Source("dash", 100.0).focal_px((800, 600))[0])
    source = Source("dash", 100.0, 0.45, vfov_degrees=down_degrees)
    seen = decode_image(as_seen(TELE, source, np.asarray(squeezed)))
    wanted = decode_image(as_seen(TELE, Source("dash", 100.0, 0.45), np.asarray(even)))
    assert np.abs(seen.astype(int) - wanted).mean() < 1.5

    (tmp_path / "dash").mkdir()
    squeezed.save(tmp_path / "dash" / "0.jpg")
    (tmp_path / "poses.csv").write_text("time_s,x_m,y_m,heading_rad\n0,0,0,0\n1,1,0,0\n")
    (doubt,) = read_folder(tmp_path, {TELE: source}).doubts()
    assert "100% too wide" in doubt
    told = f"front_tele_30=dash:100:0.45:{down_degrees}"
    assert "100% too wide" in " ".join(ran(tmp_path, tmp_path / "o", "--camera", told, code=2).split())


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("no poses", "poses.csv is missing"),
        ("no column", "heading_rad"),
        ("no number", "line 3"),
        ("backwards", "ascend"),
        ("no pictures", "no pictures"),
        ("bad name", "named after its time"),
        ("too short", "no scene"),
        ("bad camera", "no CAMERA=FOLDER"),
        ("no folder", "there is no folder"),
    ],
)
def test_what_is_no_recording_is_told_in_a_line(tmp_path: Path, change: str, reason: str) -> None:
    rows: list[list[Any]] = [
        ["time_s", "x_m", "y_m", "heading_rad"],
        *[[k / 10, k, 0, 0] for k in range(200)],
    ]
    if change == "no column":
        rows = [row[:3] for row in rows]
    elif change == "no number":
        rows[2][1] = "far"
    elif change == "backwards":
        rows[1:] = rows[:0:-1]
    elif change == "too short":
        rows = rows[:40]
    folder = tmp_path / "drive"
    (folder / "dash").mkdir(parents=True)
    if change != "no poses":
        with (folder / "poses.csv").open("w", newline="") as file:
            csv.writer(file).writerows(rows)
    if change != "no pictures":
        for k in range(40):
            picture(80, 60, 100, 0.5).save(folder / "dash" / f"{k / 2}.jpg")
    if change == "bad name":
        (folder / "dash" / "frame.jpg").write_bytes(b"")
    cameras = {
        "bad camera": ["--camera", "back=dash:100"],
        "no folder": ["--camera", "front_wide_120=nowhere:100"],
    }.get(change, BOTH)
    out = tmp_path / "scenes.parquet"
    assert reason in " ".join(ran(folder, out, *cameras, code=2).split())
    assert not out.exists()


def test_a_source_that_is_none() -> None:
    with pytest.raises(RecordingError, match="field of view"):
        Source("dash", 180.0)
    with pytest.raises(RecordingError, match="horizon"):
        Source("dash", 60.0, 2.0)
