from __future__ import annotations

import numpy as np
import pytest

from looktwice.clients.metadrive.drawing.rig import Rig
from looktwice.clients.metadrive.scenes.windows import labelled_scenes
from looktwice.clients.metadrive.world.actors import Drift
from looktwice.clients.metadrive.world.episode import run_episode
from looktwice.clients.metadrive.world.episode_log import EpisodeLog
from looktwice.model.driving.labeller import expert_plan

SEED, DURATION_S = 904, 30.0


@pytest.fixture(scope="module")
def straying() -> EpisodeLog:
    return run_episode(SEED, DURATION_S, drifts=True)


def test_a_drift_goes_out_and_comes_back_smoothly() -> None:
    drift = Drift(10.0, 0.8, 12.0, 30.0)
    places = np.linspace(5, 60, 1101)
    offsets, slopes = np.array([drift.at(s) for s in places]).T
    assert offsets[0] == offsets[-1] == 0
    assert offsets.max() == pytest.approx(0.8, abs=1e-6)
    assert places[offsets.argmax()] == pytest.approx(22.0, abs=0.1)
    np.testing.assert_allclose(np.gradient(offsets, places), slopes, atol=2e-3)


def test_the_expert_strays_by_itself_and_finds_back(straying: EpisodeLog) -> None:
    assert straying.strays.any()
    assert not run_episode(SEED, 5.0).strays.any()
    begins = np.flatnonzero(np.diff(straying.strays.astype(int)) == 1)
    back = 0
    for first in begins:
        later = np.abs(straying.lane_offsets[first : first + 70])
        assert later.max() > 0.25
        if straying.progress[first + 69] - straying.progress[first] > 40:
            assert later[-1] < 0.1, "back on its line, where it does not stop on the way"
            back += 1
    assert back


def test_what_came_before_the_first_drift_is_as_without(straying: EpisodeLog) -> None:
    first = int(np.flatnonzero(straying.strays)[0])
    without = run_episode(SEED, DURATION_S)
    np.testing.assert_array_equal(straying.ego[:first], without.ego[:first])


def test_scenes_show_the_way_back_and_never_the_way_out(straying: EpisodeLog, rig: Rig) -> None:
    scenes = list(labelled_scenes(straying, rig, 0.5, with_dense=False))
    assert scenes
    returning = 0
    for labelled in scenes:
        step = int(labelled.scene.scene_id.split("-")[1])
        assert not straying.strays[step + 1 : step + 65].any()
        offsets = np.abs(straying.lane_offsets[[step, step + 64]])
        returning += bool(offsets[0] > 0.25 > offsets[1])
        plan = expert_plan(labelled)
        assert plan.word_at("lane", 0) == "Keep Lane", "coming back is no lane change"
    assert returning >= 2
