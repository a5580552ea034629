"""What a planner meets when it drives itself, with what the expert would do from there (DAgger).

A planner that learned only from the expert's states errs in its own: small errors lead where no example was
(https://arxiv.org/abs/1011.0686). Here it drives, and at some of its plans the world is forked and the expert
goes on from where the car is. Forks in which even the expert fails are left out: there is nothing to learn.
"""

from __future__ import annotations

from looktwice.clients.metadrive.closed_loop.drives import Drive, DriveConfig, drive
from looktwice.clients.metadrive.closed_loop.pilots import Pilot
from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.scenes.lane_maps import LaneMaps
from looktwice.clients.metadrive.scenes.windows import labelled_scene
from looktwice.clients.metadrive.world.episode import EpisodeWorld
from looktwice.clients.metadrive.world.fork import ForkError, fork_expert
from looktwice.model.driving.scene import LabelledScene, Scene
from looktwice.model.driving.trajectory import FUTURE_STEPS


def own_states(
    seed: int, pilot: Pilot, rig: Rig | None = None, config: DriveConfig = DriveConfig(), every: int = 2
) -> tuple[list[LabelledScene], Drive]:
    """Let a pilot drive an episode, and label every so many-th of its plans.

    Args:
        seed: of the episode.
        pilot: that drives.
        rig: of the cameras; None for a pilot that does without, whose scenes then have no pictures.
        config: see there.
        every: so many plans lie between two scenes.

    Returns:
        Scenes whose past is the pilot's and whose future the expert's; and how the pilot drove.

    Raises:
        MapError: no map fits the seed.
        PlannerError: the pilot's service does not answer.
    """
    states: list[LabelledScene] = []
    lane_maps: LaneMaps | None = None
    plans = 0

    def label(world: EpisodeWorld, scene: Scene) -> None:
        nonlocal plans, lane_maps
        plans += 1
        if plans % every:
            return
        try:
            forked = fork_expert(world)
        except ForkError:
            return
        if not forked.is_safe or len(forked.trajectory) < FUTURE_STEPS:
            return
        lane_maps = lane_maps or LaneMaps(world.live)
        labelled = labelled_scene(forked.log, world.now, scene.clips, lane_maps.at(world.now))
        if labelled is not None:
            states.append(labelled)

    drove = drive(seed, pilot, rig, config, on_plan=label, look=rig is not None)
    return states, drove
