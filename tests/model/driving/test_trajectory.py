from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.model.driving.trajectory import (
    GeometryError,
    agreed,
    at_10_hz,
    at_times,
    check_history,
    check_route,
    check_times,
    check_trajectory,
    constant_turn_rate,
    constant_velocity,
    present_acceleration,
    present_speed,
    retimed,
    speeds,
    to_ego_frame,
    wrap_angle,
)
from tests.model.driving.drives import MIDDLES_S, drive


@pytest.mark.parametrize("speed", [0.0, 12.5, -2.0])
def test_constant_velocity_is_exact_on_a_straight(speed: float) -> None:
    future, history = drive(speed)
    assert present_speed(history) == pytest.approx(speed, abs=1e-5)
    np.testing.assert_allclose(constant_velocity(history), future, atol=2e-4)


@pytest.mark.parametrize(
    ("speed", "yaw_rate"), [(10.0, 0.3), (6.0, -0.6), (15.0, 1e-9), (-2.0, 0.2), (0.0, 0.0)]
)
def test_constant_turn_rate_is_exact_on_arcs(speed: float, yaw_rate: float) -> None:
    future, history = drive(speed, yaw_rate)
    expected = future.copy()
    expected[:, 3] = np.unwrap(expected[:, 3])
    np.testing.assert_allclose(constant_turn_rate(history), expected, atol=5e-4)


def test_speeds_are_signed_by_the_gear() -> None:
    forward, _ = drive(8.0, 0.4)
    backward, _ = drive(-3.0, 0.4)
    both = speeds(np.stack([forward, backward]))
    assert both.shape == (2, 64)
    np.testing.assert_allclose(both[0], 8.0, atol=1e-2)
    np.testing.assert_allclose(both[1], -3.0, atol=1e-2)


def test_a_way_is_driven_at_another_pace() -> None:
    fast, _ = drive(10.0, 0.2)
    slow, _ = drive(5.0, 0.1)  # around the same circle
    straight, _ = drive(5.0)
    np.testing.assert_allclose(retimed(fast, fast), fast, atol=1e-3)
    np.testing.assert_allclose(retimed(fast, straight), slow, atol=2e-2)
    ahead = retimed(slow, fast)
    np.testing.assert_allclose(ahead[:32], fast[:32], atol=2e-2)
    np.testing.assert_allclose(speeds(ahead)[32:], 10.0, atol=1e-2)
    np.testing.assert_allclose(ahead[32:, 3], slow[-1, 3], atol=1e-3, err_msg="straight on from its end")
    stands, backs = np.zeros_like(fast), drive(-3.0)[0]
    np.testing.assert_allclose(retimed(stands, straight), straight, atol=1e-3)
    np.testing.assert_allclose(retimed(fast, stands), stands, atol=1e-3)
    np.testing.assert_allclose(retimed(fast, backs), backs, atol=1e-3)


def test_ego_frame_has_x_forward_and_y_left() -> None:
    present = [10.0, 20.0, 1.0, np.pi / 2]  # looks along the world's y
    seen = to_ego_frame([[10, 25, 1, np.pi / 2], [9, 20, 1, np.pi], [10, 20, 3, -np.pi / 2]], present)
    np.testing.assert_allclose(seen[0], [5, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(seen[1], [0, 1, 0, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(seen[2], [0, 0, 2, np.pi], atol=1e-12)


@given(st.floats(-50, 50))
def test_wrapped_angles_point_the_same_way_and_lie_in_the_half_open_circle(angle: float) -> None:
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped <= np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


def test_half_a_turn_is_plus_pi() -> None:
    np.testing.assert_allclose(wrap_angle([np.pi, -np.pi]), [np.pi, np.pi])


def test_checked_arrays_are_read_only_copies() -> None:
    mine = np.zeros((64, 4), np.float64)
    checked = check_trajectory(mine)
    mine[0] = 1
    assert checked.dtype == np.float32
    assert not checked.any()
    with pytest.raises(ValueError, match="read-only"):
        checked[0] = 1


def test_what_is_no_history_trajectory_or_route_is_refused() -> None:
    history = np.zeros((16, 4))
    with pytest.raises(GeometryError, match=r"history must have shape \[16, 4\], got \[15, 4\]"):
        check_history(history[1:])
    with pytest.raises(GeometryError, match="not finite"):
        check_history(np.where(np.arange(64).reshape(16, 4) == 5, np.nan, 0.0))
    with pytest.raises(GeometryError, match="present pose"):
        check_history(history + np.array([0.1, 0, 0, 0]))
    with pytest.raises(GeometryError, match=r"beyond ±1000"):
        check_trajectory(np.full((64, 4), 1e4))
    with pytest.raises(GeometryError, match=r"route must have shape \[20, 2\]"):
        check_route(np.zeros((20, 3)))


def test_the_draw_that_the_others_agree_with_is_followed() -> None:
    draws = np.zeros((4, 64, 4), np.float32)
    draws[:, :, 1] = np.array([0.0, 1.0, 1.2, 9.0])[:, None]
    assert agreed(draws) == 1
    assert agreed(draws[:1]) == 0


@given(st.integers(0, 2**31), st.integers(1, 8), st.floats(0.3, 1.0))
def test_a_trajectory_is_where_it_says_and_between_in_a_straight_line(
    seed: int, count: int, step_s: float
) -> None:
    times_s = [step_s * (place + 1) for place in range(count)]
    poses = np.random.default_rng(seed).normal(0, 20, (count, 4)).astype(np.float32)
    poses[:, 3] %= 1.0
    np.testing.assert_allclose(at_times(poses, times_s, times_s[::-1]), poses[::-1], atol=1e-5)
    halfway = [time_s - step_s / 2 for time_s in times_s]
    before = np.concatenate([np.zeros((1, 4)), poses[:-1]])
    np.testing.assert_allclose(at_times(poses, times_s, halfway), (before + poses) / 2, atol=1e-4)


def test_headings_turn_the_short_way_round() -> None:
    poses = np.array([[0, 0, 0, 3.0], [0, 0, 0, -3.0]], np.float32)
    assert at_times(poses, (1.0, 2.0), (1.5,))[0, 3] == pytest.approx(np.pi, abs=1e-5)


@pytest.mark.parametrize(("times_s", "rows"), [((0.5, 1.0), 10), ((0.25,), 2), ((4.0, 8.0), 64)])
def test_ten_poses_a_second_end_with_the_last_pose_or_after_6_4_s(
    times_s: tuple[float, ...], rows: int
) -> None:
    assert at_10_hz(np.ones((len(times_s), 4), np.float32), times_s).shape == (rows, 4)


@pytest.mark.parametrize("times_s", [(), (0.0, 1.0), (1.0, 1.0), (2.0, 1.0), (61.0,), (float("nan"),)])
def test_times_ascend_from_the_present(times_s: tuple[float, ...]) -> None:
    with pytest.raises(GeometryError, match="times must ascend"):
        check_times(times_s)


def test_a_route_that_leads_nowhere_is_refused() -> None:
    for stands in (np.zeros((20, 2)), np.full((20, 2), 7.0)):
        with pytest.raises(GeometryError, match="leads nowhere"):
            check_route(stands)
    assert check_route(np.stack([np.zeros(20), 4.0 * np.arange(20)], axis=1)).shape == (20, 2)


@pytest.mark.parametrize("acceleration_ms2", [-3.0, 0.0, 1.5])
def test_the_present_acceleration(acceleration_ms2: float) -> None:
    for yaw_rate in (0.0, 0.2):
        _, history = drive(9.0 + acceleration_ms2 * MIDDLES_S, yaw_rate)
        assert present_acceleration(history) == pytest.approx(acceleration_ms2, abs=0.02)
