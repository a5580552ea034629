"""Critics learn what comes of trajectories, and nothing else of a checkpoint moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.facts import FACTS
from looktwice.model.driving.outcome import VERDICTS
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.driving.trajectory import POSE_MIRROR
from looktwice.model.network.alternatives import ALTERNATIVES
from looktwice.model.network.checkpoint import Loaded, load, with_second_sketches, with_sketches
from looktwice.model.training.batches import stacked
from looktwice.model.training.critics import CriticLearner, VerdictDataset, told_apart
from looktwice.model.training.examples import Examples
from looktwice.model.training.judged_sketches import SOURCES, JudgedSketches
from tests.model.training.scenes import training_scene


@pytest.fixture(scope="module")
def loaded(resampling_checkpoint: Path) -> Loaded:
    return load(resampling_checkpoint)


@pytest.fixture(scope="module")
def examples() -> Examples:
    return Examples.from_scenes([training_scene(index) for index in range(6)], (FRONT_WIDE, FRONT_TELE))


def judged(examples: Examples) -> JudgedSketches:
    """The expert's futures hold with all alternatives, and the same at a crawl fall behind."""
    crawl = np.array([0.1, 0.1, 1, 1], np.float32)
    poses = np.stack(
        [examples.future * (crawl if number % 2 else 1) for number in range(len(SOURCES))], axis=1
    )
    verdicts = np.zeros((len(examples), len(SOURCES), 1 + len(ALTERNATIVES)), np.int64)
    verdicts[:, 1::2] = VERDICTS.index("behind")
    return JudgedSketches(np.arange(len(examples)), poses[..., [0, 1, 3]].astype(np.float32), verdicts)


@pytest.fixture
def data(examples: Examples) -> VerdictDataset:
    read = np.zeros((len(examples), 2, 2, len(FACTS)), np.float32)
    read[:, 1] = 1
    return VerdictDataset(examples, judged(examples), read)


def test_a_mirrored_sample_is_the_other_way_round(data: VerdictDataset) -> None:
    plain, mirrored = (data.look(len(SOURCES) + 1, mirror=mirror) for mirror in (False, True))
    np.testing.assert_array_equal(mirrored.poses, plain.poses * POSE_MIRROR[[0, 1, 3]])
    np.testing.assert_array_equal(mirrored.history, plain.history * POSE_MIRROR)
    assert (plain.read == 0).all()
    assert (mirrored.read == 1).all()
    assert (plain.verdicts == VERDICTS.index("behind")).all()
    np.testing.assert_array_equal(plain.verdicts, mirrored.verdicts)


def test_the_route_is_known_where_it_was_to_who_sketched(data: VerdictDataset, examples: Examples) -> None:
    [place, *_] = np.flatnonzero(examples.has_route)
    known = [
        bool(data.look(int(place) * len(SOURCES) + n, mirror=False).has_route) for n in range(len(SOURCES))
    ]
    assert known == [route for _, route in SOURCES]


def test_every_tenth_episode_is_left_out(data: VerdictDataset) -> None:
    many = Examples.from_scenes([training_scene(index) for index in range(40)], (FRONT_WIDE, FRONT_TELE))
    read = np.zeros((len(many), 2, 2, len(FACTS)), np.float32)
    learned, left_out = VerdictDataset(many, judged(many), read).split()
    assert sorted(learned + left_out) == list(range(40 * len(SOURCES)))
    assert set(many.episode[np.array(left_out) // len(SOURCES)]) == {9}
    assert 9 not in many.episode[np.array(learned) // len(SOURCES)]
    assert data.split() == (list(range(len(data))), []), "of two episodes none is"


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
