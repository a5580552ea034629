"""What a planner meets when it drives itself, with what the expert would do from there (DAgger).

A planner that learned only from the expert's states errs in its own: small errors lead where no example was
(https://arxiv.org/abs/1011.0686). Here it drives, and at every other plan the world is forked and the expert
goes on from where the car is. Forks in which even the expert fails are left out: there is nothing to learn.
"""

from __future__ import annotations

from dataclasses import dataclass

from clients.metadrive.drive import Drive, DriveConfig, drive
from clients.metadrive.episode import World
from clients.metadrive.fork import ForkError, fork_expert
from clients.metadrive.pilots import Pilot
from model.driving.scene import Scene
from model.driving.trajectory import FUTURE_STEPS, FloatArray


@dataclass(frozen=True, eq=False)
class OwnState:
    """A moment of a drive, and the expert's way on from it.

    Attributes:
        seed: of the episode.
        scene: what the planner saw.
        future: float32 [64, 4], the expert's trajectory from there.
    """

    seed: int
    scene: Scene
    future: FloatArray


def own_states(
    seed: int, pilot: Pilot, config: DriveConfig = DriveConfig(), every: int = 2
) -> tuple[list[OwnState], Drive]:
    """Let a pilot without eyes drive an episode, and label every so many-th of its plans.

    Raises:
        MapError: no map fits the seed.
    """
    states: list[OwnState] = []
    plans = 0

    def label(world: World, scene: Scene) -> None:
        nonlocal plans
        plans += 1
        if plans % every:
            return
        try:
            forked = fork_expert(world)
        except ForkError:
            return
        if forked.is_safe and len(forked.trajectory) == FUTURE_STEPS:
            states.append(OwnState(seed, scene, forked.trajectory))

    drove = drive(seed, pilot, None, config, on_plan=label)
    return states, drove
