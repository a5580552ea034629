"""What a planner meets when it drives itself, with what somebody better would do from there (DAgger).

A planner that learned only from the expert's states errs in its own: small errors lead where no example was
(https://arxiv.org/abs/1011.0686). Here it drives, and at some of its plans the world is forked and the expert
goes on from where the car is, on request at another speed. Where even the expert collides, the scene shows
how it brakes; forks in which it leaves the road are left out.

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
from looktwice.clients.metadrive.generation.other_speeds import another_speed
from looktwice.clients.metadrive.scenes.lane_maps import LaneMaps
from looktwice.clients.metadrive.scenes.windows import labelled_scene, taught_scene
from looktwice.clients.metadrive.world.car_following import EMERGENCY_BRAKE
from looktwice.clients.metadrive.world.episode import EpisodeWorld
from looktwice.clients.metadrive.world.fork import ForkError, fork_expert
from looktwice.clients.metadrive.world.hazards import MANY
from looktwice.model.driving.facts import hazard_ahead
from looktwice.model.driving.scene import LabelledScene, Scene
from looktwice.model.driving.trajectory import FUTURE_STEPS, STEP_S, FloatArray


def own_states(
    seed: int,
    pilot: Pilot,
    rig: Rig | None = None,
    config: DriveConfig = DriveConfig(),
    every: int = 2,
    teacher: Pilot | None = None,
    *,
    hazards: bool = False,
    speeds: bool = False,
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
        speeds: the expert takes over at another speed, by chance (`another_speed`), which no picture shows.

    Returns:
        Scenes whose past is the pilot's and whose future the teacher's; and how the pilot drove.

    Raises:
        MapError: no map fits the seed.
        PlannerError: the pilot's service does not answer.
    """
    states = _States(every, teacher, hazards, speeds)
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
    speeds: bool
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
        times = another_speed(world) if self.speeds else 1.0
        try:
            forked = fork_expert(world, times_speed=times)
        except ForkError:
            return None
        if forked.off_road_s is not None:
            return None
        if forked.collided_s is not None:
            made = taught_scene(
                world.live, world.now, scene.clips, braked(forked.trajectory, forked.speeds_ms)
            )
            return made.at_speed(times)
        if len(forked.trajectory) < FUTURE_STEPS:
            return None
        self.lane_maps = self.lane_maps or LaneMaps(world.live)
        scored = labelled_scene(forked.log, world.now, scene.clips, self.lane_maps.at(world.now))
        return None if scored is None else scored.at_speed(times)


def braked(trajectory: FloatArray, speeds_ms: FloatArray) -> FloatArray:
    """A trajectory [k, 4] that a collision ended as if nobody had been hit: [64, 4], braking to a stop.

    Args:
        trajectory: at least one pose at 10 Hz.
        speeds_ms: [k].
    """
    steps = np.arange(1, FUTURE_STEPS - len(trajectory) + 1)
    speeds = np.maximum(float(speeds_ms[-1]) - EMERGENCY_BRAKE * STEP_S * steps, 0.0)
    last = trajectory[-1]
    rest = np.tile(last, (len(steps), 1))
    rest[:, :2] += np.outer(np.cumsum(speeds) * STEP_S, [np.cos(last[3]), np.sin(last[3])])
    return np.concatenate([trajectory, rest]).astype(np.float32)
