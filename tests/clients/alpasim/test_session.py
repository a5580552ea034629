from __future__ import annotations

import math

import numpy as np
import pytest

from looktwice.clients.alpasim.egomotion import Observed
from looktwice.clients.alpasim.errors import BadObservation, BadSession, TooEarly
from looktwice.clients.alpasim.session import CAMERAS, Session

NOW_US = 5_000_000
HEADING = math.pi / 2
ALONG_Y = (0.0, 0.0, math.sin(HEADING / 2), math.cos(HEADING / 2))


def session(cameras: dict[str, str] | None = None) -> Session:
    return Session("one", 3, {*CAMERAS.values(), "camera_rear"}, cameras or CAMERAS)


def drive_on(of: Session, until_us: int = NOW_US, speed_mps: float = 10.0) -> None:
    """Along y."""
    for time_us in range(0, until_us + 1, 100_000):
        of.add_pose(time_us, Observed((7.0, speed_mps * time_us / 1e6, 0.0, HEADING), ALONG_Y))
        for name in CAMERAS.values():
            of.add_picture(name, time_us, f"{name} {time_us}".encode())


def test_the_scene_is_what_was_seen() -> None:
    one = session()
    drive_on(one)
    moment = one.moment(NOW_US)
    assert [clip.camera for clip in moment.scene.clips] == list(CAMERAS)
    assert moment.scene.clips[1].images == tuple(
        f"camera_front_tele_30fov {time_us}".encode() for time_us in (3_500_000, 4_000_000, 4_500_000, NOW_US)
    )
    np.testing.assert_allclose(moment.scene.history[:, 0], np.arange(-15, 1), atol=1e-4)
    np.testing.assert_allclose(moment.scene.history[:, 1:], 0.0, atol=1e-4)
    assert moment.scene.route is None
    assert moment.present == Observed((7.0, 50.0, 0.0, HEADING), ALONG_Y)


@pytest.mark.parametrize("before", [True, False])
def test_a_route_stays_where_it_is_in_the_world(before: bool) -> None:
    one = session()
    points = [(4.0 * step, 2.0) for step in range(40)]
    if before:
        one.set_route(4_000_000, points)
    drive_on(one)
    if not before:
        one.set_route(4_000_000, points)
    route = one.moment(NOW_US).scene.route
    assert route is not None
    np.testing.assert_allclose(route, [(4.0 * step, 2.0) for step in range(1, 21)], atol=1e-3)
    one.set_route(NOW_US, [])
    assert one.moment(NOW_US).scene.route is None


def test_nothing_can_be_planned_before_enough_was_seen() -> None:
    one = session()
    with pytest.raises(TooEarly):
        one.moment(0)
    drive_on(one, 1_400_000)
    with pytest.raises(TooEarly):
        one.moment(1_400_000)
    drive_on(one, 1_500_000)
    one.moment(1_500_000)


def test_cameras_are_those_that_were_declared() -> None:
    one = session()
    assert one.uses("camera_front_tele_30fov")
    assert not one.uses("camera_rear")
    with pytest.raises(BadObservation, match="'camera_left' was not declared; declared are camera_front"):
        one.uses("camera_left")
    with pytest.raises(BadSession, match=r"lacks cam_x \(as front_tele_30\).*--camera"):
        session({**CAMERAS, "front_tele_30": "cam_x"})


def test_one_camera_may_play_two() -> None:
    both = dict.fromkeys(CAMERAS, "camera_front_wide_120fov")
    one = session(both)
    drive = session()
    drive_on(drive)
    for time_us in range(0, NOW_US + 1, 100_000):
        one.add_pose(time_us, Observed((0.0, 0.0, 0.0, 0.0), ALONG_Y))
        one.add_picture("camera_front_wide_120fov", time_us, b"picture")
    clips = one.moment(NOW_US).scene.clips
    assert [clip.camera for clip in clips] == list(CAMERAS)
    assert clips[0].images == clips[1].images
