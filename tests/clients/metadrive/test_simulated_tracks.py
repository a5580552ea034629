from __future__ import annotations

import numpy as np

from looktwice.clients.metadrive.scenes.simulated_tracks import tracks_at
from looktwice.clients.metadrive.scenes.windows import _Moment
from looktwice.clients.metadrive.world.episode import run_episode
from looktwice.model.driving.tracks import tracks_of
from tests.clients.metadrive.conftest import SEED


def test_a_car_in_the_loop_is_told_what_training_scenes_tell() -> None:
    log = run_episode(SEED, 20.0)
    for step in (15, 60, 110):
        told, learned = tracks_at(log, step), tracks_of(_Moment(log, step).agents)
        assert len(told) >= 1
        for track in told:
            if np.hypot(track.x_m, track.y_m) > 75:
                continue
            same = min(learned, key=lambda other: np.hypot(other.x_m - track.x_m, other.y_m - track.y_m))
            assert np.hypot(same.x_m - track.x_m, same.y_m - track.y_m) < 1e-3
            assert abs(same.speed_ms - track.speed_ms) < 0.05
            assert abs(same.heading_rad - track.heading_rad) < 1e-3
            assert (same.kind, same.lights) == (track.kind, track.lights)
