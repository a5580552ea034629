"""Scenes in which the car is slower or faster than it was, with what the expert would do from there.

In a recording, speed says nearly all of what comes, so who learns from recordings alone copies it (causal
confusion, https://arxiv.org/abs/1905.11979). Here the world is forked with another speed, and what is around
decides. Pictures would still show the speed that was, so these scenes have none.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from looktwice.clients.metadrive.scenes.lane_maps import LaneMaps
from looktwice.clients.metadrive.scenes.windows import blank_clips, labelled_scene, stride_steps
from looktwice.clients.metadrive.world.episode import EpisodeWorld
from looktwice.clients.metadrive.world.episode_log import EpisodeLog
from looktwice.clients.metadrive.world.fork import ForkError, fork_expert
from looktwice.model.driving.cameras import FRONT_CAMERAS
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.trajectory import FUTURE_STEPS, HISTORY_STEPS

_TIMES: Final = (0.4, 1.6)
_STANDING_MS: Final = 0.5


def other_speeds(
    worlds: Iterable[EpisodeWorld], stride_s: float
) -> tuple[list[LabelledScene], EpisodeLog, int]:
    """Scenes of an episode at other speeds; those that even the expert cannot save are left out.

    Args:
        worlds: of `worlds_of_episode`.
        stride_s: seconds from scene to scene.

    Returns:
        The scenes, the episode as it went, and how many moments were tried.

    Raises:
        MapError: no map fits the seed.
    """
    scenes: list[LabelledScene] = []
    tried = 0
    lane_maps: LaneMaps | None = None
    stride = stride_steps(stride_s)
    for world in worlds:
        step = world.now - (HISTORY_STEPS - 1)
        if step < 0 or step % stride or world.ego.speed < _STANDING_MS:
            continue
        times = another_speed(world)
        try:
            forked = fork_expert(world, times_speed=times)
        except ForkError:
            break
        tried += 1
        if not forked.is_safe or len(forked.trajectory) < FUTURE_STEPS:
            continue
        lane_maps = lane_maps or LaneMaps(world.live)
        made = labelled_scene(forked.log, world.now, blank_clips(FRONT_CAMERAS), lane_maps.at(world.now))
        if made is not None:
            scenes.append(made.at_speed(times))
    return scenes, world.log(), tried


def another_speed(world: EpisodeWorld) -> float:
    """What the ego's speed is multiplied by, by chance: always the same at the same moment."""
    return float(np.random.default_rng([world.live.seed, world.now]).uniform(*_TIMES))
