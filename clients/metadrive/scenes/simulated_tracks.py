"""The tracks of a moment: what a perfect tracker would tell of everybody around the ego."""

from __future__ import annotations

import math

import numpy as np

from looktwice.clients.metadrive.scenes.annotate import to_ego
from looktwice.clients.metadrive.world.episode_log import ActorLog, EpisodeLog, lights_on
from looktwice.model.driving.tracks import SPEED_STEPS, TRACK_REACH_M, Track, nearest_tracks
from looktwice.model.driving.trajectory import STEP_S


def tracks_at(log: EpisodeLog, step: int) -> tuple[Track, ...]:
    """The nearest tracks at ``step``, as `looktwice.model.driving.tracks.tracks_of` tells them of a labelled
    scene."""
    ego = log.ego[step]
    near = (
        actor
        for actor in log.actors
        if math.hypot(actor.poses[step, 0] - ego[0], actor.poses[step, 1] - ego[1]) < TRACK_REACH_M
    )
    return nearest_tracks(_track(actor, log, step) for actor in near)


def _track(actor: ActorLog, log: EpisodeLog, step: int) -> Track:
    pose, before = actor.poses[step], actor.poses[max(step - SPEED_STEPS, 0)]
    speed = 0.0
    if np.isfinite(before[0]):
        moved = pose[:2] - before[:2]
        speed = float(math.cos(pose[2]) * moved[0] + math.sin(pose[2]) * moved[1]) / (SPEED_STEPS * STEP_S)
    x, y = (float(value) for value in to_ego(pose[:2], log.ego[step]))
    heading = math.remainder(float(pose[2] - log.ego[step, 2]), 2 * math.pi)
    lights = lights_on(int(actor.lights[step]))
    return Track(x, y, heading, speed, *actor.size[:2], actor.kind, lights)
