"""Verdicts among recorded others are those of the simulator, and its car is the same car."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from looktwice.clients.metadrive.outcomes.replayed_worlds import (
    EpisodeSetting,
    FollowTask,
    Moment,
    ReplayError,
    outcomes_of_episode,
)
from looktwice.clients.metadrive.world.tracking import FreeVehicle, world_trajectory
from looktwice.model.driving.driven_car import follow_all
from looktwice.model.driving.outcome import VERDICTS
from looktwice.model.driving.recorded_outcome import verdicts_among_recorded
from looktwice.model.driving.trajectory import FUTURE_STEPS, STEP_S, FloatArray, paced, speeds
from tests.clients.metadrive.conftest import DURATION_S, SEED, Filmed


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 1000))
def test_many_cars_follow_as_the_simulator_s_does(seed: int) -> None:
    random = np.random.default_rng(seed)
    speed, acceleration = float(random.uniform(-2, 25)), float(random.uniform(-4, 2))
    trajectories = np.stack([_wild(random, speed) for _ in range(5)])
    rides = follow_all(trajectories, speed, acceleration)
    # No rails to be found on: what it follows is the trajectory alone.
    nowhere: Any = SimpleNamespace(rails=[])
    for trajectory, poses, driven_ms in zip(trajectories, rides.poses, rides.speeds_ms, strict=True):
        car = FreeVehicle(0, "vehicle", "130", 0.0, 0.0, 0.0, speed, 0.0)
        car.acceleration = acceleration
        way = world_trajectory(np.array([0.0, 0.0, 0.0, speed]), trajectory)
        for step in range(FUTURE_STEPS):
            car.follow(way, step * STEP_S, nowhere)
            assert math.dist(poses[step], (car.x, car.y, car.heading)) < 1e-6
            assert abs(driven_ms[step] - car.speed) < 1e-6


def _wild(random: np.random.Generator, speed: float) -> FloatArray:
    """A trajectory [64, 4] at changing speeds along a changing way."""
    pace = speed + np.cumsum(random.normal(0, 0.4, FUTURE_STEPS))
    heading = np.cumsum(np.cumsum(random.normal(0, 0.003, FUTURE_STEPS)))
    trajectory = np.zeros((FUTURE_STEPS, 4), np.float32)
    trajectory[:, 0], trajectory[:, 1] = (np.cumsum(STEP_S * pace * f(heading)) for f in (np.cos, np.sin))
    trajectory[:, 3] = heading
    return trajectory


def _ways(future: FloatArray) -> npt.NDArray[np.float32]:
    """The expert's way, at half and twice its pace, stopping, and beside it."""
    pace = speeds(future)
    aside = future.copy()
    aside[:, 1] += 0.08 * np.arange(1, FUTURE_STEPS + 1, dtype=np.float32)
    return np.stack([future, *(paced(future, share * pace) for share in (0.5, 2.0, 0.0)), aside])


def test_verdicts_are_the_simulator_s(filmed: Filmed) -> None:
    tasks = [FollowTask(Moment.of(each), list(_ways(each.future))) for each in filmed.scenes]
    followed = dict(outcomes_of_episode(SEED, EpisodeSetting(DURATION_S, drifts=False, lapses=False), tasks))
    same, seen = [], set()
    for labelled in filmed.scenes:
        outcomes, found = (
            followed[labelled.scene.scene_id],
            verdicts_among_recorded(labelled, _ways(labelled.future)),
        )
        assert not isinstance(outcomes, ReplayError | str)
        assert found is not None
        assert found[0] == 0, "the expert's own way holds"
        for outcome, verdict in zip(outcomes.plans, found, strict=True):
            same.append(outcome.holds == (VERDICTS[verdict] == "holds"))
            seen.add(outcome.verdict)
    assert np.mean(same) > 0.95
    assert len(seen) > 3, "plans fail in several ways"
