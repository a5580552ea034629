"""What small planners sketch in recorded scenes, and the verdicts on it."""

from __future__ import annotations

import numpy as np
import pytest

from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.outcome import VERDICTS
from looktwice.model.driving.recorded_outcome import verdicts_among_recorded
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import FUTURE_STEPS
from looktwice.model.network.alternatives import ALTERNATIVES
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.network.small_planner import load_small
from looktwice.model.training.examples import Examples, load_examples
from looktwice.model.training.intents import read_facts
from looktwice.model.training.judged_sketches import SOURCES, JudgedSketches, judge_sketches
from looktwice.model.training.vision_cache import open_vision

TRACKS, EXPERT = SOURCES.index(("tracks", True)), SOURCES.index(("expert", True))


@pytest.fixture(scope="module")
def loaded() -> Loaded:
    return load(CHECKPOINT)


@pytest.fixture(scope="module")
def examples(loaded: Loaded, tmp_path_factory: pytest.TempPathFactory) -> Examples:
    return load_examples(SCENES, tmp_path_factory.mktemp("cache"), loaded.settings.cameras, 1)


@pytest.fixture(scope="module")
def judged(loaded: Loaded, examples: Examples, tmp_path_factory: pytest.TempPathFactory) -> JudgedSketches:
    vision = open_vision(loaded, examples, tmp_path_factory.mktemp("vision"), mirrored=False)
    read = read_facts(loaded.model, examples, vision)
    return judge_sketches(loaded.model, loaded.codec, examples, read, SCENES, workers=0)


def test_the_expert_s_own_way_holds(examples: Examples, judged: JudgedSketches) -> None:
    assert judged.verdicts.shape == (len(judged.examples), len(SOURCES), 1 + len(ALTERNATIVES))
    assert (judged.verdicts[:, EXPERT, 0] == VERDICTS.index("holds")).all()
    assert (judged.verdicts[:, EXPERT, 1:] > 0).any(), "and something else does not"
    np.testing.assert_array_equal(judged.poses[:, EXPERT], examples.future[judged.examples][..., [0, 1, 3]])


def test_sketches_are_those_of_the_small_planner(judged: JudgedSketches) -> None:
    planner, scenes = load_small(CHECKPOINT), list(read_scenes(SCENES))
    for place, poses, verdicts in zip(judged.examples, judged.poses, judged.verdicts, strict=True):
        [planned] = planner.plan([scenes[place].given(route=True, tracks=True)])
        assert np.abs(planned[:, [0, 1, 3]] - poses[TRACKS]).max() < 0.01
        trajectory = np.zeros((1, FUTURE_STEPS, 4), np.float32)
        trajectory[0, :, [0, 1, 3]] = poses[TRACKS].T
        found = verdicts_among_recorded(scenes[place], trajectory)
        assert found is not None
        assert found[0] == verdicts[TRACKS, 0]
