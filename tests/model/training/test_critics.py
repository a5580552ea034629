"""Critics learn what comes of trajectories, and nothing else of a checkpoint moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.facts import FACTS
from looktwice.model.driving.followed_store import FollowedTrajectory
from looktwice.model.driving.outcome import VERDICTS, Verdict
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.driving.trajectory import POSE_MIRROR
from looktwice.model.network.checkpoint import Loaded, load, with_second_sketches, with_sketches
from looktwice.model.training.batches import stacked
from looktwice.model.training.critics import CriticLearner, VerdictDataset, place_verdicts, told_apart
from looktwice.model.training.examples import Examples
from tests.model.training.scenes import training_scene


@pytest.fixture(scope="module")
def loaded(resampling_checkpoint: Path) -> Loaded:
    return load(resampling_checkpoint)


@pytest.fixture(scope="module")
def examples() -> Examples:
    return Examples.from_scenes([training_scene(index) for index in range(6)], (FRONT_WIDE, FRONT_TELE))


def followed(examples: Examples, count: int = 40) -> list[FollowedTrajectory]:
    """Futures that hold, and the same at a crawl, which fall behind."""
    rows = []
    for number in range(count):
        place = number % len(examples)
        slow = number % 2
        trajectory = examples.future[place] * np.array([0.1, 0.1, 1, 1] if slow else [1] * 4, np.float32)
        verdict: Verdict = "behind" if slow else "holds"
        rows.append(FollowedTrajectory(str(examples.scene_id[place]), trajectory, "", verdict, "x 1"))
    return rows


@pytest.fixture
def data(examples: Examples) -> VerdictDataset:
    read = np.zeros((len(examples), 2, 2, len(FACTS)), np.float32)
    read[:, 1] = 1
    return VerdictDataset(examples, place_verdicts(examples, followed(examples)), read, 0.5)


def test_a_mirrored_sample_is_the_other_way_round(data: VerdictDataset) -> None:
    plain, mirrored = (data.look(3, mirror=mirror, route=True) for mirror in (False, True))
    np.testing.assert_array_equal(mirrored.poses, plain.poses * POSE_MIRROR[[0, 1, 3]])
    np.testing.assert_array_equal(mirrored.history, plain.history * POSE_MIRROR)
    assert (plain.read == 0).all()
    assert (mirrored.read == 1).all()
    assert plain.verdict == mirrored.verdict == VERDICTS.index("behind")


def test_scenes_that_are_missing_are_named(examples: Examples) -> None:
    [first, *_] = followed(examples)
    with pytest.raises(ValueError, match="999999-0001"):
        place_verdicts(examples, [replace(first, scene_id="999999-0001")])
    with pytest.raises(ValueError, match="no followed trajectories"):
        place_verdicts(examples, [])


def test_every_tenth_episode_is_left_out(data: VerdictDataset) -> None:
    many = Examples.from_scenes([training_scene(index) for index in range(40)], (FRONT_WIDE, FRONT_TELE))
    read = np.zeros((len(many), 2, 2, len(FACTS)), np.float32)
    placed = place_verdicts(many, followed(many, 80))
    learned, left_out = VerdictDataset(many, placed, read, 0.5).split()
    assert sorted(learned + left_out) == list(range(80))
    assert set(many.episode[placed.examples[left_out]]) == {9}
    assert 9 not in many.episode[placed.examples[learned]]
    assert data.split() == (list(range(40)), []), "of two episodes none is"


def test_critics_learn_and_all_else_stays(loaded: Loaded, data: VerdictDataset) -> None:
    sketching = loaded if loaded.settings.sketch_tokens else with_sketches(loaded, 3)
    wider = with_second_sketches(sketching)
    before = {name: value.clone() for name, value in wider.model.state_dict().items()}
    learner = CriticLearner(wider.model).train()
    optimiser = torch.optim.AdamW(learner.parameters(), 2e-3)
    losses = []
    for _ in range(60):
        batch = stacked([data[index] for index in range(len(data))])
        out = learner(**batch)
        optimiser.zero_grad()
        out["loss"].backward()
        optimiser.step()
        losses.append(float(out["tracks_verdict_loss"]))
    assert losses[-1] < 0.5 * losses[0]
    assert min(told_apart(learner, data, range(len(data))).values()) > 0.9
    assert learner.training
    moved = {name for name, value in wider.model.state_dict().items() if not torch.equal(value, before[name])}
    assert moved
    assert all(".critic." in name for name in moved)


def test_a_checkpoint_without_second_sketches_is_refused(loaded: Loaded) -> None:
    with pytest.raises(ValueError, match="no second sketches"):
        CriticLearner(loaded.model)
