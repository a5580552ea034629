"""Forks: what would happen if, without touching what does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from looktwice.clients.metadrive.world.actors import STEP_S, Pedestrian, Vehicle
from looktwice.clients.metadrive.world.car_following import SpeedLimits, Style, neighbours
from looktwice.clients.metadrive.world.episode import EpisodeWorld, make_world
from looktwice.clients.metadrive.world.expert import Expert
from looktwice.clients.metadrive.world.fork import ForkError, fork_along, fork_expert, on_rails
from looktwice.clients.metadrive.world.tracking import FreeVehicle
from looktwice.model.driving.trajectory import FUTURE_STEPS, constant_velocity, to_ego_frame
from tests.clients.metadrive.conftest import SEED


def driven(steps: int, seconds: float = 20.0, seed: int = SEED) -> EpisodeWorld:
    world = make_world(seed, seconds)
    near = world.remember()
    while world.now < steps and not world.ended:
        world.move(near, world.drive_as_expert)
        near = world.remember()
    return world


def real_future(step: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    ego = driven(step + FUTURE_STEPS).live.ego[step : step + FUTURE_STEPS + 1]
    poses = np.zeros((len(ego), 4))
    poses[:, :2], poses[:, 3] = ego[:, :2], ego[:, 2]
    return to_ego_frame(poses, poses[0])[1:]


@pytest.mark.parametrize("step", [0, 37, 90])
def test_on_rails_a_fork_is_the_real_future(step: int) -> None:
    forked = fork_expert(driven(step))
    assert np.abs(forked.trajectory[:, :2] - real_future(step)[:, :2]).max() < 1e-4  # of float32
    assert forked.is_safe
    assert forked.driven_m > 0


def test_a_fork_leaves_the_world_it_came_from_alone() -> None:
    world, untouched = driven(40), driven(40)
    for _ in range(2):
        fork_expert(world)
        fork_along(world, constant_velocity(np.zeros((16, 4), np.float32)))
    for each in (world, untouched):
        near = each.nearby()
        while each.now < 120:
            each.move(near, each.drive_as_expert)
            near = each.remember()
    np.testing.assert_array_equal(world.log().ego, untouched.log().ego)
    assert [a.actor_id for a in world.log().actors] == [a.actor_id for a in untouched.log().actors]


def test_a_fork_goes_on_beyond_the_episode_s_end() -> None:
    world = driven(195, seconds=20.0)
    assert len(fork_expert(world).trajectory) == FUTURE_STEPS


def test_an_ended_world_cannot_be_forked() -> None:
    world = driven(60, seconds=5.1)
    assert world.ended
    with pytest.raises(ForkError, match=r"has ended \(time\)"):
        fork_expert(world)


def test_a_car_that_was_driven_astray_comes_back_to_its_lane() -> None:
    world = driven(60)
    ego = FreeVehicle.from_rails(world.ego)
    ego.x -= 1.0 * np.sin(ego.heading)
    ego.y += 1.0 * np.cos(ego.heading)
    ego.heading += 0.06
    world.ego = ego
    world.live.ego[world.now] = ego.x, ego.y, ego.heading, ego.speed
    railed = on_rails(ego, world.live.road_map)
    railed.place(world.live.road_map.rails)
    assert np.hypot(railed.x - ego.x, railed.y - ego.y) < 0.05
    assert railed.heading == pytest.approx(ego.heading, abs=0.02)
    forked = fork_expert(world)
    assert forked.is_safe
    start = np.hypot(*forked.trajectory[0, :2])
    assert start == pytest.approx(ego.speed * 0.1, abs=0.15), "it goes on as fast as it was"
    assert isinstance(world.ego, FreeVehicle)


@pytest.mark.parametrize("taken_over", [False, True])
def test_who_takes_over_brakes_where_the_expert_would_swerve(taken_over: bool) -> None:
    """At 12 m/s, a car has broken down 20 m ahead, and the lane beside is free."""
    road_map = driven(0).live.road_map
    rails, style = road_map.rails, Style(15.0)
    expert = Expert(road_map, style, SpeedLimits(rails, style.lateral), ambition=True, eager=False)
    if taken_over:
        expert.take_over()
    me, car = (Vehicle(number, "vehicle", "130", 0, 0, 0, 12.0, 40.0) for number in range(2))
    me.rail, me.s = next(
        (number, rail.s_at(me.progress))
        for number, rail in enumerate(rails)
        if rail.covers(me.progress, 0.0) and neighbours(replace(me, rail=number, s=rail.s_at(40.0)), road_map)
    )
    car.rail, car.s, car.progress = me.rail, me.s + 20.0 + me.size[0], me.progress + 20.0 + me.size[0]
    car.speed, car.hold, car.hazard_lights = 0.0, True, True
    for vehicle in (me, car):
        vehicle.place(rails)
    for _ in range(40):
        expert.step(me, [me, car])
    if taken_over:
        assert me.shift is None
        assert me.speed < 0.5
        assert me.s < car.s - me.size[0], "it stands behind the car"
    else:
        assert me.s > car.s, "it has gone round the car"


@pytest.mark.parametrize(("left_m", "brakes"), [(-3.0, True), (-7.0, False)])
@pytest.mark.parametrize("taken_over", [False, True])
def test_who_takes_over_brakes_for_people_whom_it_can_no_longer_yield_to(
    taken_over: bool, left_m: float, brakes: bool
) -> None:
    """At 14 m/s, somebody walks towards the lane 14 m ahead, too near to stop for."""
    road_map = driven(0).live.road_map
    rails, style = road_map.rails, Style(15.0)
    expert = Expert(road_map, style, SpeedLimits(rails, style.lateral), ambition=True, eager=False)
    if taken_over:
        expert.take_over()
    me = Vehicle(0, "vehicle", "130", 0, 0, 0, 14.0, 40.0)
    me.rail = next(number for number, rail in enumerate(rails) if rail.covers(me.progress, 0.0))
    me.s = rails[me.rail].s_at(me.progress)
    me.place(rails)
    ahead = me.s + 14.0 + 0.5 * me.size[0]
    x, y, along = rails[me.rail].pose(ahead, left_m)
    progress = rails[me.rail].progress(ahead)
    person = Pedestrian(1, "pedestrian", "pedestrian", x, y, along + np.pi / 2, 0.0, progress)
    person.walking, person.walk_m, person.walking_speed = True, 10.0, 1.4
    person.step()
    for _ in range(round(0.8 / STEP_S)):
        expert.step(me, [me, person])
        person.step()
    if taken_over and brakes:
        assert me.speed < 11.0
    else:
        assert me.speed > 13.5


def test_following_the_expert_s_trajectory_is_safe_and_leaving_the_road_is_not() -> None:
    world = driven(60)
    expert = fork_expert(world)
    followed = fork_along(world, expert.trajectory)
    assert followed.is_safe
    assert followed.driven_m == pytest.approx(expert.driven_m, rel=0.1)
    aside = expert.trajectory.copy()
    aside[:, 1] += np.linspace(0, 30, FUTURE_STEPS)
    off = fork_along(world, aside)
    assert not off.is_safe


def test_whom_a_fork_hits_is_told() -> None:
    """Somewhere in a few episodes, going on blindly hits somebody."""
    hits = []
    for seed in range(400_000, 400_012):
        world = driven(100, seed=seed)
        history = np.zeros((16, 4), np.float32)
        history[:, 0] = 3.0 * np.arange(-15, 1)
        forked = fork_along(world, constant_velocity(history))
        if forked.collided_s is not None:
            hits.append(forked.hit)
            assert len(forked.trajectory) == round(forked.collided_s * 10)
            assert not world.ended
        if len(hits) == 2:
            break
    assert hits
    assert None not in hits


def test_the_expert_heeds_only_those_whom_it_knows_of() -> None:
    world = driven(100)
    plain, all_known = fork_expert(world), fork_expert(world, known=range(10_000))
    np.testing.assert_array_equal(plain.trajectory, all_known.trajectory)
    assert fork_expert(world, known=()).driven_m > plain.driven_m + 10


def test_vehicles_on_rails_follow_a_trajectory_as_free_ones() -> None:
    world = driven(60)
    assert type(world.ego) is Vehicle
    forked = fork_along(world, fork_expert(world).trajectory, steps=20)
    assert len(forked.trajectory) == 20
    assert type(world.ego) is Vehicle
