from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.training.dense import DENSE_SHAPE
from looktwice.model.training.examples import Examples
from looktwice.model.training.grounding import (
    GroundingDataset,
    GroundingItem,
    GroundingLearner,
    collate_grounding,
)
from looktwice.model.training.looks import LookLearner, in_other_lights
from tests.model.training.scenes import training_scene

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def loaded(resampling_checkpoint: Path) -> Loaded:
    return load(resampling_checkpoint)


@pytest.fixture(scope="module")
def examples() -> Examples:
    return Examples.from_scenes([training_scene(index) for index in range(6)], (FRONT_WIDE, FRONT_TELE))


@pytest.fixture(scope="module")
def looking(loaded: Loaded, examples: Examples) -> LookLearner:
    learner = GroundingLearner(loaded.model, loaded.codec, DENSE_SHAPE)
    return LookLearner(learner, examples, loaded.inputs, CPU)


def test_looks_on_a_device_are_those_of_the_dataset(
    loaded: Loaded, examples: Examples, looking: LookLearner
) -> None:
    data = GroundingDataset(examples, loaded.inputs)
    places, mirror, route = [4, 1, 0, 1], [True, False, True, True], [True, False, True, True]
    items = [GroundingItem(*each) for each in zip(places, mirror, route, strict=True)]
    wanted = collate_grounding([data.look(item) for item in items])
    found = looking.look(
        torch.tensor(places),
        mirror=torch.tensor(mirror),
        route=torch.tensor(route),
        lit=torch.zeros(4, dtype=torch.bool),
    )
    assert found.keys() == wanted.keys()
    for name, values in wanted.items():
        assert found[name].dtype == values.dtype, name
        np.testing.assert_array_equal(found[name].numpy(), values.numpy(), err_msg=name)


def test_scenes_are_lit_apart_and_their_pictures_alike() -> None:
    torch.manual_seed(0)
    grey = torch.full((40, 2, 8, 8, 3), 128, dtype=torch.uint8)
    lights = in_other_lights(grey).int()
    means = lights.double().mean(dim=(1, 2, 3))
    assert (means - 128).abs().max() < 128 * 0.3 + 10
    assert means.std(dim=0).min() > 5, "scenes differ"
    assert (means.amax(dim=1) - means.amin(dim=1)).max() > 5, "colours differ"
    over_pictures = lights.amax(dim=(1, 2, 3)) - lights.amin(dim=(1, 2, 3))
    assert over_pictures.max() <= 5, "one scene's pictures are in one light, but for noise"


def test_the_same_places_are_looked_at_in_many_ways(looking: LookLearner) -> None:
    torch.manual_seed(0)
    losses = {float(looking(torch.tensor([1]))["fact_loss"]) for _ in range(6)}
    assert len(losses) > 3


def test_only_what_is_learned_is_kept(looking: LookLearner) -> None:
    assert all(name.startswith("learner.") for name in looking.state_dict())
