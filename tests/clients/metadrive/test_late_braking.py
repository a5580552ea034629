from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.scenes.windows import labelled_scenes
from looktwice.clients.metadrive.world.episode import run_episode
from looktwice.clients.metadrive.world.episode_log import EpisodeLog

SEED, DURATION_S = 6011, 48.0


@pytest.fixture(scope="module")
def late() -> EpisodeLog:
    return run_episode(SEED, DURATION_S, lapses=True)


@pytest.fixture(scope="module")
def in_time() -> EpisodeLog:
    return run_episode(SEED, DURATION_S)


def spans(log: EpisodeLog) -> list[tuple[int, int]]:
    """First step of each lapse, and the first behind it."""
    edges = np.flatnonzero(np.diff(log.strays.astype(int), prepend=0, append=0))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def hardest(log: EpisodeLog, first: int, end: int) -> float:
    """Of all accelerations between two steps the lowest, m/s²."""
    return float(np.diff(log.ego[first:end, 3]).min() / 0.1)


def test_who_does_not_heed_brakes_late_and_hard_and_collides_with_nobody(
    late: EpisodeLog, in_time: EpisodeLog
) -> None:
    first, end = spans(late)[0]
    assert not in_time.strays.any()
    assert late.outcome == "time"
    assert late.ego[end, 3] > in_time.ego[end, 3] + 0.5, "faster than who heeds"
    assert hardest(late, end, end + 25) < -3.0
    assert hardest(late, end, end + 25) < hardest(in_time, first, end + 25) - 1.0


def test_what_came_before_the_first_lapse_is_as_without(late: EpisodeLog, in_time: EpisodeLog) -> None:
    first, _ = spans(late)[0]
    np.testing.assert_array_equal(late.ego[:first], in_time.ego[:first])


def test_lapses_lie_apart_and_no_scenes_future_holds_one(late: EpisodeLog, rig: Rig) -> None:
    lapses = spans(late)
    assert len(lapses) >= 2
    assert all(later[0] - earlier[1] > 64 for earlier, later in pairwise(lapses))
    steps = [
        int(labelled.scene.scene_id.split("-")[1])
        for labelled in labelled_scenes(late, rig, 0.5, with_dense=False)
    ]
    assert steps
    assert not any(late.strays[step + 1 : step + 65].any() for step in steps)
    assert any(0 <= step - end < 10 for step in steps for _, end in lapses), "one begins right behind a lapse"
