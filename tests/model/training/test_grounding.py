from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.facts import FACTS, mirrored
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.training.dense import DENSE_SHAPE, UNLABELLED
from looktwice.model.training.examples import Examples
from looktwice.model.training.grounding import (
    GroundingDataset,
    GroundingItem,
    GroundingLearner,
    collate_grounding,
    fact_loss,
    in_other_light,
    looked_at,
)
from tests.model.training.scenes import training_scene

SCENES = [training_scene(index) for index in range(6)]


@pytest.fixture(scope="module")
def loaded(resampling_checkpoint: Path) -> Loaded:
    return load(resampling_checkpoint)


@pytest.fixture(scope="module")
def data(loaded: Loaded) -> GroundingDataset:
    return GroundingDataset(Examples.from_scenes(SCENES, (FRONT_WIDE, FRONT_TELE)), loaded.inputs)


def test_a_mirrored_look_swaps_everything_and_twice_is_as_before(data: GroundingDataset) -> None:
    plain, swapped = data.look(GroundingItem(1)), data.look(GroundingItem(1, mirror=True))
    np.testing.assert_array_equal(swapped.facts, mirrored(plain.facts))
    np.testing.assert_array_equal(swapped.classes, plain.classes[..., ::-1])
    np.testing.assert_array_equal(swapped.motion[:, 1], -plain.motion[:, 1, :, ::-1])
    np.testing.assert_array_equal(swapped.futures[:, 1], -plain.futures[:, 1])
    assert not np.array_equal(swapped.patches, plain.patches)


def test_another_light_changes_levels_and_nothing_that_is_known(data: GroundingDataset) -> None:
    plain, lit = data.look(GroundingItem(1)), data.look(GroundingItem(1), np.random.default_rng(3))
    np.testing.assert_equal(lit._replace(patches=plain.patches)._asdict(), plain._asdict())
    assert not np.array_equal(lit.patches, plain.patches)
    grey = np.full((2, 8, 8, 3), 128, np.uint8)
    lights = np.stack([in_other_light(grey, np.random.default_rng(seed)) for seed in range(40)]).astype(int)
    means = lights.mean(axis=(1, 2, 3))
    assert np.abs(means - 128).max() < 128 * 0.3 + 10
    assert means.std(axis=0).min() > 5, "scenes differ"
    assert (means.max(axis=1) - means.min(axis=1)).max() > 5, "colours differ"
    assert np.ptp(lights, axis=(2, 3)).max() <= 5, "one scene's pictures are in one light, but for noise"


def test_a_route_is_given_only_where_there_is_one(data: GroundingDataset) -> None:
    assert not data.look(GroundingItem(0)).has_route
    assert data.look(GroundingItem(1)).has_route
    assert not data.look(GroundingItem(1, route=False)).has_route


def test_scenes_with_a_walker_or_an_obstacle_are_looked_at_more_often() -> None:
    examples = Examples.from_scenes([training_scene(number) for number in range(4)], (FRONT_WIDE,))
    for fact in ("walker_0_present", "own_obstacle_present"):
        examples.facts[:, FACTS.index(fact)] = 0
    examples.facts[1, FACTS.index("walker_0_present")] = 1
    examples.facts[2] = np.nan
    examples.facts[3, [FACTS.index("walker_0_present"), FACTS.index("own_obstacle_present")]] = 1
    examples.pictured[3] = False
    assert sorted(looked_at(examples)) == [0, 1, 1, 1, 2]


def test_facts_that_do_not_apply_cost_nothing() -> None:
    facts = torch.full((1, len(FACTS)), float("nan"))
    facts[0, FACTS.index("own_0_gap_log_m")] = 2.0
    right = torch.full((1, len(FACTS)), 7.0)
    right[0, FACTS.index("own_0_gap_log_m")] = 2.0
    weights = torch.ones(len(FACTS))
    assert float(fact_loss(right, facts, weights)) == 0.0
    assert float(fact_loss(right + 1, facts, weights)) > 1.0


def test_tower_and_resampler_learn_what_is_seen(loaded: Loaded, data: GroundingDataset) -> None:
    learner = GroundingLearner(loaded.model, loaded.codec, DENSE_SHAPE)
    learner.eval()  # without dropout the loss can only fall
    batch = collate_grounding([data.look(GroundingItem(index)) for index in range(4)])
    optimizer = torch.optim.AdamW(learner.parameters(), lr=3e-4)
    losses = []
    for _ in range(12):
        parts = learner(**batch)
        optimizer.zero_grad()
        parts["loss"].backward()
        optimizer.step()
        losses.append({name: float(value.detach()) for name, value in parts.items()})
    for name in ("class_loss", "range_error_log", "motion_error", "fact_loss", "plan_ade_m"):
        assert losses[-1][name] < losses[0][name], name


def test_scenes_without_dense_targets_teach_their_facts(loaded: Loaded, data: GroundingDataset) -> None:
    learner = GroundingLearner(loaded.model, loaded.codec, DENSE_SHAPE)
    batch = collate_grounding([data.look(GroundingItem(index)) for index in range(2)])
    batch["classes"] = torch.full_like(batch["classes"], UNLABELLED)
    parts = learner(**batch)
    assert float(parts["class_loss"]) == 0.0
    assert float(parts["fact_loss"].detach()) > 0.0
    assert torch.isfinite(parts["loss"])


def test_what_is_gathered_depends_on_pictures_history_and_route(
    loaded: Loaded, data: GroundingDataset
) -> None:
    learner = GroundingLearner(loaded.model, loaded.codec, DENSE_SHAPE).eval()
    batch = collate_grounding([data.look(GroundingItem(1))])
    names = ("patches", "history", "route", "has_route")
    _, as_it_is = learner.gather(**{name: batch[name] for name in names})
    for name, change in (
        ("patches", batch["patches"].flip(0)),
        ("history", batch["history"] * 1.5),
        ("route", batch["route"] * torch.tensor([1.0, -2.0]) + 1.0),
        ("has_route", ~batch["has_route"]),
    ):
        _, other = learner.gather(**{key: batch[key] for key in names} | {name: change})
        assert not torch.allclose(as_it_is, other, atol=1e-4), name
