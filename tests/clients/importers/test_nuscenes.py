"""A small drive in nuScenes' layout, written by ourselves."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from looktwice.clients.importers.nuscenes import read_nuscenes
from looktwice.clients.importers.recording import RecordingError
from looktwice.clients.importers.rotations import matrices
from looktwice.model.driving.cameras import FRONT_CAMERAS
from looktwice.model.driving.images import decode_image
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import present_speed
from looktwice.service.cli.commands import app

WIDE, TELE = (spec.resized(336) for spec in FRONT_CAMERAS)
SPEED_MPS, TURN_RADPS, RADIUS_M = 10.0, 0.08, 125.0
SIZE = (400, 225)
FOCAL_PX = (310.0, 340.0)  # not square
YAWS_DEGREES = {"CAM_FRONT": 1.0, "CAM_FRONT_LEFT": 55.0, "CAM_FRONT_RIGHT": -55.0}
PITCH_DEGREES = 3.0
INTRINSICS = [[FOCAL_PX[0], 0, 206.0], [0, FOCAL_PX[1], 120.0], [0, 0, 1]]


def times(first: list[float], second: list[float]) -> list[float]:
    """Hamilton's product."""
    a, b, c, d = first
    e, f, g, h = second
    return [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]


def about(axis: int, degrees: float) -> list[float]:
    turn = [math.cos(math.radians(degrees) / 2), 0.0, 0.0, 0.0]
    turn[1 + axis] = math.sin(math.radians(degrees) / 2)
    return turn


def mounted(yaw_degrees: float) -> list[float]:
    """From a camera's axes (x right, y down, z ahead) to the car's; it looks a little down."""
    upright = [0.5, -0.5, 0.5, -0.5]
    return times(times(about(2, yaw_degrees), about(1, PITCH_DEGREES)), upright)


def shown(channel: str) -> Image.Image:
    """Red tells the angle to the left of straight ahead, in degrees and 128; blue is sky, green is road."""
    column, row = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.stack([(column - 206) / FOCAL_PX[0], (row - 120) / FOCAL_PX[1], np.ones_like(row)], -1)
    ego = rays @ matrices(np.array(mounted(YAWS_DEGREES[channel]))).T
    pixels = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    pixels[..., 0] = np.clip(128 + np.degrees(np.arctan2(ego[..., 1], ego[..., 0])), 0, 255)
    pixels[..., 1] = np.where(ego[..., 2] <= 0, 255, 0)
    pixels[..., 2] = np.where(ego[..., 2] > 0, 255, 0)
    return Image.fromarray(pixels)


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Two scenes of the tables, the second without pictures; 12 s, cameras at 12 Hz, a lidar at 20 Hz."""
    root = tmp_path / "nuscenes"
    tables: dict[str, list[dict[str, Any]]] = {
        "sensor": [{"token": f"s-{name}", "channel": name} for name in (*YAWS_DEGREES, "LIDAR_TOP")],
        "calibrated_sensor": [
            {
                "token": f"c-{name}",
                "sensor_token": f"s-{name}",
                "translation": [1.5, 0, 1.5],
                "rotation": mounted(YAWS_DEGREES.get(name, 0)),
                "camera_intrinsic": INTRINSICS if name in YAWS_DEGREES else [],
            }
            for name in (*YAWS_DEGREES, "LIDAR_TOP")
        ],
        "scene": [{"token": "t-1", "name": "scene-0061"}, {"token": "t-2", "name": "scene-0103"}],
        "sample": [],
        "ego_pose": [],
        "sample_data": [],
    }
    for scene in ("t-1", "t-2"):
        for channel, rate_hz in (*((name, 12) for name in YAWS_DEGREES), ("LIDAR_TOP", 20)):
            for step in range(12 * rate_hz):
                time_s = step / rate_hz
                if step % (rate_hz // 2) == 0 and channel == "LIDAR_TOP":
                    tables["sample"].append({"token": f"{scene}-{int(2 * time_s)}", "scene_token": scene})
                token = f"{scene}-{channel}-{step}"
                turned = TURN_RADPS * time_s
                tables["ego_pose"].append(
                    {
                        "token": token,
                        "timestamp": round(1.5e15 + 1e6 * time_s),
                        "rotation": times(about(2, 170), about(2, math.degrees(turned))),
                        "translation": [
                            600
                            + RADIUS_M * (math.sin(turned + math.radians(170)) - math.sin(math.radians(170))),
                            900
                            - RADIUS_M * (math.cos(turned + math.radians(170)) - math.cos(math.radians(170))),
                            0.0,
                        ],
                    }
                )
                place = "samples" if step % (rate_hz // 2) == 0 else "sweeps"
                name = f"{place}/{channel}/{scene}-{step}.jpg"
                tables["sample_data"].append(
                    {
                        "token": token,
                        "sample_token": f"{scene}-{int(2 * time_s)}",
                        "ego_pose_token": token,
                        "calibrated_sensor_token": f"c-{channel}",
                        "timestamp": round(1.5e15 + 1e6 * time_s),
                        "filename": name,
                    }
                )
    (root / "v1.0-mini").mkdir(parents=True)
    for table, rows in tables.items():
        (root / "v1.0-mini" / f"{table}.json").write_text(json.dumps(rows))
    for channel in YAWS_DEGREES:
        picture = shown(channel)
        for row in tables["sample_data"]:
            if row["token"].startswith("t-1") and f"/{channel}/" in row["filename"]:
                path = root / row["filename"]
                path.parent.mkdir(parents=True, exist_ok=True)
                if not (first := path.parent / "first.jpg").exists():
                    picture.save(first, quality=95)
                path.hardlink_to(first)
    return root


def ran(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["scenes", "import", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return " ".join(result.output.split())


def test_its_scenes_become_ours(drive: Path, tmp_path: Path) -> None:
    assert "5 scenes" in ran(drive, tmp_path / "scenes.parquet", "--stride", 1)
    scenes = list(read_scenes(tmp_path / "scenes.parquet"))
    assert {labelled.episode_id for labelled in scenes} == {"scene-0061"}
    for labelled in scenes:
        assert present_speed(labelled.scene.history) == pytest.approx(SPEED_MPS, abs=0.05)
        x, y, _, heading = labelled.future[-1]
        turned = 6.4 * TURN_RADPS
        assert (x, y) == pytest.approx(
            (RADIUS_M * math.sin(turned), RADIUS_M * (1 - math.cos(turned))), abs=0.2
        )
        assert heading == pytest.approx(turned, abs=0.01)


@pytest.mark.parametrize("spec", [WIDE, TELE], ids=lambda spec: str(spec.name))
def test_three_cameras_are_one(drive: Path, spec: Any) -> None:
    (recording,) = read_nuscenes(drive, (spec,))
    assert recording.doubts() == []
    encoded = recording.eyes[0].at(1.5e9 + 4.0)
    assert encoded is not None
    seen = decode_image(encoded).astype(float)
    columns = np.degrees(np.arctan2(spec.width / 2 - (np.arange(spec.width) + 0.5), spec.focal_px))
    horizon = round(spec.horizon * spec.height)
    row = seen[horizon + 8]
    # Where one camera's picture meets the next, JPEG's colours bleed.
    assert np.percentile(np.abs(row[:, 0] - 128 - columns), 95) < 5
    assert seen[horizon - 6, spec.width // 2, 2] > 200
    assert seen[horizon + 6, spec.width // 2, 1] > 200


def test_missing_sides_are_told(drive: Path, tmp_path: Path) -> None:
    for file in [*drive.rglob("CAM_FRONT_LEFT/*")]:
        file.unlink()
    told = ran(drive, tmp_path / "scenes.parquet", "--stride", 5)
    assert "no pictures of CAM_FRONT_LEFT: the sides of front_wide_120 are grey" in told


def test_cameras_are_not_to_be_told(drive: Path, tmp_path: Path) -> None:
    assert "a folder of your own" in ran(
        drive, tmp_path / "out", "--camera", "front_wide_120=CAM_FRONT:65", code=2
    )


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("no table", "ego_pose.json cannot be read"),
        ("no column", "columns .*rotation"),
        ("no pose", "lacks the pose"),
        ("two versions", "v1.0-mini, v1.0-trainval"),
        ("no pictures", "none of the pictures of CAM_FRONT"),
        ("damaged picture", "t-1-0.jpg"),
    ],
)
def test_what_is_damaged_is_told(drive: Path, change: str, reason: str) -> None:
    poses = drive / "v1.0-mini" / "ego_pose.json"
    rows = json.loads(poses.read_text())
    if change == "no table":
        poses.unlink()
    elif change == "no column":
        del rows[0]["rotation"]
        poses.write_text(json.dumps(rows))
    elif change == "no pose":
        poses.write_text(json.dumps(rows[1:]))
    elif change == "two versions":
        (drive / "v1.0-trainval").mkdir()
    elif change == "no pictures":
        for file in [*drive.rglob("CAM_FRONT/*")]:
            file.unlink()
    elif change == "damaged picture":
        (drive / "samples" / "CAM_FRONT" / "t-1-0.jpg").unlink()
        (drive / "samples" / "CAM_FRONT" / "t-1-0.jpg").write_bytes(b"no picture")
    with pytest.raises(RecordingError, match=reason):
        [list(recording.scenes(stride_s=1)) for recording in read_nuscenes(drive, (TELE,))]
