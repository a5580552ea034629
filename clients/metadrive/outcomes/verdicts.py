"""What comes of a plan: followed in a fork of the world, it holds or fails, and at what.

A plan is followed by a car with a driver's limits while everybody else reacts
(`looktwice.clients.metadrive.world.fork`), and is compared with the expert's own way on from the same moment,
followed by the same car. Bounds of comfort are those of NAVSIM (`looktwice.model.driving.pdm.comfort`). All
other thresholds are those of `looktwice.model.driving.outcome`: chosen on training scenes, where the expert's
own trajectories pass them (docs/labelling.md has the figures).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from looktwice.clients.metadrive.world.episode import EpisodeWorld
from looktwice.clients.metadrive.world.fork import Forked, fork_along, fork_expert
from looktwice.model.driving.driven_car import CAR, ride_states
from looktwice.model.driving.outcome import Outcome, failures
from looktwice.model.driving.pdm.comfort import comfort
from looktwice.model.driving.trajectory import STEP_S, FloatArray


@dataclass(frozen=True)
class MomentOutcomes:
    """How the expert and some plans fared from one moment on.

    Attributes:
        expert: of the expert's own way on, followed by the same car as the plans are.
        plans: of each plan, in their order.
        better: for each plan the place of the first of its other trajectories that holds; None where the plan
            holds itself, or none of them does, or the expert's own way fails too.
    """

    expert: Outcome
    plans: tuple[Outcome, ...]
    better: tuple[int | None, ...]


def outcomes_at(
    world: EpisodeWorld,
    trajectories: Sequence[FloatArray],
    others: Sequence[Sequence[FloatArray]] = (),
    driven: Forked | None = None,
) -> MomentOutcomes:
    """Follow each of some trajectories [64, 4] of the ego frame of now, each in a fork of its own.

    Args:
        world: at the moment; nothing happens in it.
        trajectories: of the plans.
        others: for each of them trajectories [64, 4] that are followed instead where it fails, one after the
            other until one holds; () where nothing else is to be tried.
        driven: the expert's fork from this moment, where it is there already.

    Raises:
        ForkError: the episode has ended.
    """
    driven = fork_expert(world) if driven is None else driven
    expert = judged(fork_along(world, driven.trajectory), driven.driven_m)
    strict, expert_m = expert.uncomfortable is None, driven.driven_m

    def followed(trajectory: FloatArray) -> Outcome:
        return judged(fork_along(world, trajectory), expert_m, needs_comfort=strict)

    plans = tuple(followed(trajectory) for trajectory in trajectories)
    better: list[int | None] = [None] * len(plans)
    for place, instead in enumerate(others):
        if expert.holds and not plans[place].holds:
            better[place] = next((n for n, each in enumerate(instead) if followed(each).holds), None)
    return MomentOutcomes(expert, plans, tuple(better))


def judged(followed: Forked, expert_m: float, *, needs_comfort: bool = False) -> Outcome:
    """The outcome of a followed plan where the expert drives ``expert_m`` along the route.

    Args:
        followed: what came of the plan.
        expert_m: as far as the expert comes from the same moment.
        needs_comfort: whether a broken bound of comfort is a failure. It is none where the expert breaks one
            itself: a person who runs into the road leaves no comfortable way.
    """
    uncomfortable_s, uncomfortable = _discomfort(followed)
    fails = failures(
        collided=followed.collided_s is not None,
        off_road=followed.off_road_s is not None,
        off_route=followed.off_route_s is not None,
        rough=needs_comfort and uncomfortable is not None,
        driven_m=followed.driven_m,
        expert_m=expert_m,
    )
    return Outcome(
        fails,
        _tenths(followed.collided_s),
        followed.hit,
        _tenths(followed.off_road_s),
        _tenths(followed.off_route_s),
        uncomfortable_s,
        uncomfortable,
        round(followed.driven_m, 2),
        round(expert_m, 2),
    )


def _discomfort(followed: Forked) -> tuple[float | None, str | None]:
    """When a ride first breaks a bound of comfort, and which; neither of one that ends in a collision."""
    if followed.collided_s is not None:
        return None, None
    poses, speeds_ms = followed.trajectory[:, [0, 1, 3]], followed.speeds_ms
    states = ride_states(poses[None].astype(np.float64), speeds_ms[None].astype(np.float64))
    found = comfort(states, CAR, "v2.2")
    if found.holds[0]:
        return None, None
    return _tenths((int(found.first_step[0]) + 1) * STEP_S), found.bound[0]


def _tenths(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 1)
