from __future__ import annotations

from dataclasses import astuple

import numpy as np
import numpy.typing as npt
import pytest

from looktwice.model.driving.cameras import CAMERA_SPECS
from looktwice.model.driving.next_view import (
    FAR_M,
    Motion,
    expected_view,
    expected_views,
    motion_along,
    moved_view,
)
from looktwice.model.driving.trajectory import GeometryError, to_ego_frame

FRONT = CAMERA_SPECS["front"]


def marked(camera_name: str, point: tuple[float, float, float]) -> npt.NDArray[np.uint8]:
    """A black picture with a white spot where a camera sees a point of the ego frame."""
    frame = np.zeros((112, 224, 3), np.uint8)
    column, row, depth = CAMERA_SPECS[camera_name].project(np.array([point]))[0]
    assert depth > 0
    frame[int(row) - 2 : int(row) + 3, int(column) - 2 : int(column) + 3] = 255
    return frame


def spot(frame: npt.NDArray[np.uint8]) -> tuple[float, float]:
    """Column and row of the middle of what is white."""
    rows, columns = np.nonzero(frame[..., 0])
    return float(columns.mean()), float(rows.mean())


def test_a_motion_takes_the_place_of_momentum() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (112, 224, 3), np.uint8)
    history = np.zeros((16, 4), np.float32)
    history[:, 0] = np.arange(-15, 1)
    moved = expected_view(frame, "front", history, Motion(2.0, 0.5, 0.1))
    np.testing.assert_array_equal(moved, moved_view(frame, FRONT, np.array([2.0, 0.5, 0.1])))
    np.testing.assert_array_equal(expected_view(frame, "front", history, Motion(0.0, 0.0, 0.0)), frame)
    assert (expected_view(frame, "front", history) != moved).any()


@pytest.mark.parametrize("turn", [0.0, 0.08])
def test_earlier_pictures_show_the_road_where_the_last_one_does(turn: float) -> None:
    steps = 15 - np.arange(16)
    history = np.zeros((16, 4), np.float32)
    history[:, 0], history[:, 3] = -0.6 * steps, -turn * steps / 5
    history[:, 1] = 0.02 * steps
    mark = np.array([16.0, 0.5, 0.0, 0.0])
    frames = [
        marked("front", tuple(to_ego_frame(mark, history[row].astype(np.float64))[:3])) for row in (5, 10, 15)
    ]
    views = expected_views(frames, "front", history)
    np.testing.assert_array_equal(views[-1], expected_view(frames[-1], "front", history))
    spots = np.array([spot(view) for view in views])
    assert np.abs(spots - spots[-1]).max() < 2
    moving = expected_views([frames[-1]] * 3, "front", history)
    assert abs(spot(moving[0])[1] - spot(moving[-1])[1]) > 4


@pytest.mark.parametrize(
    "pose", [(40.1, 0.0, 0.0), (-30.0, 30.0, 0.0), (np.nan, 0.0, 0.0), (1.0, 0.0, np.inf)]
)
def test_a_motion_that_nobody_makes_is_refused(pose: tuple[float, float, float]) -> None:
    with pytest.raises(GeometryError, match="in half a second; 40 m are the most"):
        Motion(*pose)


TURNING = np.array([[1.0, 0.0, 0.1, 0.1], [3.0, 0.5, 0.2, 0.3]])


@pytest.mark.parametrize(
    ("times_s", "expected"),
    [
        ((0.5, 1.0), (1.0, 0.0, 0.1)),
        ((0.1, 0.5), (3.0, 0.5, 0.3)),
        ((0.25, 0.75), (2.0, 0.25, 0.2)),
        ((0.4, 0.8), (1.5, 0.125, 0.15)),
    ],
)
def test_half_a_second_of_a_trajectory_lies_between_its_poses(
    times_s: tuple[float, ...], expected: tuple[float, float, float]
) -> None:
    assert astuple(motion_along(TURNING, times_s)) == pytest.approx(expected)
    behind = np.concatenate([TURNING[:, :3], np.array([[3.1], [-3.1]])], axis=1)
    halfway = motion_along(behind, (0.4, 0.6)).heading_rad
    assert np.cos(halfway) == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("poses", "times_s", "message"),
    [
        (TURNING, (0.6, 1.0), "beyond the horizon of a trajectory from 0.6 s to 1 s"),
        (TURNING, (0.1, 0.4), "beyond the horizon of a trajectory from 0.1 s to 0.4 s"),
        (TURNING, (1.0, 0.5), "times must ascend"),
        (TURNING, (0.5,), r"shape \[1, 4\], got \[2, 4\]"),
        (TURNING * [[20.0, 1, 1, 1]], (0.4, 0.5), r"nobody comes to \(60.0, 0.5\) m"),
        (TURNING * np.nan, (0.4, 0.5), "not finite"),
    ],
)
def test_a_trajectory_that_does_not_tell_of_it_is_refused(
    poses: npt.NDArray[np.float64], times_s: tuple[float, ...], message: str
) -> None:
    with pytest.raises(GeometryError, match=message):
        motion_along(poses, times_s)


@pytest.mark.parametrize("camera", ["front", "front_left", "back_right", "back"])
def test_who_stays_sees_the_same(camera: str) -> None:
    frame = np.random.default_rng(0).integers(0, 256, (112, 224, 3), np.uint8)
    np.testing.assert_array_equal(moved_view(frame, CAMERA_SPECS[camera], np.zeros(3)), frame)


@pytest.mark.parametrize(
    ("camera", "point"),
    [("front", (20.0, 1.0, 0.0)), ("front_left", (8.0, 8.0, 0.0)), ("back", (-9.0, 1.0, 0.0))],
)
def test_a_point_of_the_road_is_where_it_will_be(camera: str, point: tuple[float, float, float]) -> None:
    pose = np.array([3.0, 0.4, 0.1])
    seen = spot(moved_view(marked(camera, point), CAMERA_SPECS[camera], pose))
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x_m, y_m = point[0] - pose[0], point[1] - pose[1]
    then = np.array([[cos * x_m + sin * y_m, -sin * x_m + cos * y_m, 0.0]])
    assert seen == pytest.approx(CAMERA_SPECS[camera].project(then)[0, :2], abs=2.0)


def test_a_turn_moves_what_is_far_to_the_other_side() -> None:
    frame = marked("front", (FAR_M + FRONT.forward_m, 0.0, 3.0))
    left_turn = spot(moved_view(frame, FRONT, np.array([0.0, 0.0, 0.1])))
    right_turn = spot(moved_view(frame, FRONT, np.array([0.0, 0.0, -0.1])))
    assert right_turn[0] + 10 < spot(frame)[0] < left_turn[0] - 10


def test_it_fits_pictures_of_other_sizes() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (56, 112, 3), np.uint8)
    assert moved_view(frame, FRONT, np.array([5.0, 0.0, 0.0])).shape == frame.shape
