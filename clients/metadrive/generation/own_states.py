"""What a planner meets when it drives itself, with what somebody better would do from there (DAgger).

A planner that learned only from the expert's states errs in its own: small errors lead where no example was
(https://arxiv.org/abs/1011.0686). Here it drives, and at some of its plans the world is forked and the expert
goes on from where the car is. Forks in which even the expert fails are left out: there is nothing to learn.

A fork costs a quarter of a second. A planner that is told the tracks answers at once what it would do, so it
may be the teacher in the expert's place (https://arxiv.org/abs/1912.12294); then nothing is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from looktwice.clients.metadrive.closed_loop.drives import Drive, DriveConfig, drive
from looktwice.clients.metadrive.closed_loop.pilots import Pilot
from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.scenes.lane_maps import LaneMaps
from looktwice.clients.metadrive.scenes.windows import labelled_scene, taught_scene
from looktwice.clients.metadrive.world.episode import EpisodeWorld
from looktwice.clients.metadrive.world.fork import ForkError, fork_expert
from looktwice.clients.metadrive.world.hazards import MANY
from looktwice.model.driving.facts import hazard_ahead
from looktwice.model.driving.scene import LabelledScene, Scene
from looktwice.model.driving.trajectory import FUTURE_STEPS


def own_states(
    seed: int,
    pilot: Pilot,
    rig: Rig | None = None,
    config: DriveConfig = DriveConfig(),
    every: int = 2,
    teacher: Pilot | None = None,
    *,
    hazards: bool = False,
) -> tuple[list[LabelledScene], Drive]:
    """Let a pilot drive an episode, and label every so many-th of its plans.

    Args:
        seed: of the episode.
        pilot: that drives.
        rig: of the cameras; None for a pilot that does without, whose scenes then have no pictures.
        config: see there.
        every: so many plans lie between two scenes, at least.
        teacher: says what to do from there, told the tracks; None for the expert.
        hazards: many wait along the route, and only moments with one ahead become scenes.

    Returns:
        Scenes whose past is the pilot's and whose future the teacher's; and how the pilot drove.

    Raises:
        MapError: no map fits the seed.
        PlannerError: the pilot's service does not answer.
    """
    states = _States(every, teacher, hazards)
    return states.labelled, drive_among(seed, pilot, rig, config, states.meet, hazards=hazards)


def drive_among(
    seed: int,
    pilot: Pilot,
    rig: Rig | None,
    config: DriveConfig,
    meet: Callable[[EpisodeWorld, Scene], None],
    *,
    hazards: bool,
) -> Drive:
    """Let a pilot drive an episode, among many hazards or the usual ones, and ``meet`` each of its plans."""
    among = replace(config, hazards=MANY) if hazards else config
    return drive(seed, pilot, rig, among, on_plan=meet, look=rig is not None)


@dataclass
class _States:
    every: int
    teacher: Pilot | None
    hazards: bool
    labelled: list[LabelledScene] = field(default_factory=list)
    plans: int = 0
    lane_maps: LaneMaps | None = None

    def meet(self, world: EpisodeWorld, scene: Scene) -> None:
        """Label a plan's moment, where it is its turn."""
        self.plans += 1
        if self.plans < self.every or (self.hazards and not hazard_ahead(scene)):
            return
        self.plans = 0
        if self.teacher is not None:
            future = np.asarray(self.teacher.plan(scene).trajectory)
            self.labelled.append(taught_scene(world.live, world.now, scene.clips, future))
        elif (forked := self._of_expert(world, scene)) is not None:
            self.labelled.append(forked)

    def _of_expert(self, world: EpisodeWorld, scene: Scene) -> LabelledScene | None:
        try:
            forked = fork_expert(world)
        except ForkError:
            return None
        if not forked.is_safe or len(forked.trajectory) < FUTURE_STEPS:
            return None
        self.lane_maps = self.lane_maps or LaneMaps(world.live)
        return labelled_scene(forked.log, world.now, scene.clips, self.lane_maps.at(world.now))
