from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model.driving.plan import parse_plan
from model.driving.scene_store import write_scenes
from model.driving.trajectory import constant_velocity
from model.network.checkpoint import load
from model.training.outcomes import OutcomeLearner
from model.training.recipes import NANO, OutcomeSettings, Recipe
from model.training.rewards import RewardWeights, rewards
from model.training.run import RunSettings, run
from tests.model.driving.drives import MIDDLES_S, agent, labelled_scene
from tests.model.evaluation.fakes import draw_of
from tests.model.training.scenes import training_scene

BRAKES = labelled_scene(np.maximum(0, 12 - 4 * np.maximum(MIDDLES_S, 0)), agents=(agent(26.0, 0.0),))
"""An expert who stops behind a car that stands in its way."""
ACCELERATES = parse_plan(
    "- longitudinal\n  - 0.0s-6.4s: Accelerate\n- lateral\n  - 0.0s-6.4s: Straight\n"
    "- lane\n  - 0.0s-6.4s: Keep Lane\n"
)


def test_who_stops_in_time_is_worth_more_than_who_does_not() -> None:
    straight_on = constant_velocity(BRAKES.scene.history)
    found, parts = rewards(BRAKES, [draw_of(BRAKES.future), draw_of(straight_on)])
    assert found[0] > found[1] + 0.5
    # Not comfortable, but right.
    assert found[0] > 0.8
    assert parts["collision_rate"] == 0.5
    assert parts["ade_m"] > 5


def test_thinking_and_contradictions_cost_what_they_are_said_to() -> None:
    weights = RewardWeights(outcome=0.0, imitation=0.0, words=0.25, thinking=0.125)
    direct, looked = (
        draw_of(BRAKES.future, ACCELERATES),
        draw_of(BRAKES.future, ACCELERATES, revised=ACCELERATES),
    )
    found, parts = rewards(BRAKES, [direct, looked], weights)
    assert parts["think_rate"] == 0.5
    # The plan says that the car accelerates all the time, and it stops.
    assert found[0] == pytest.approx(-0.25)
    assert found[1] == pytest.approx(-0.25 - 0.125)


def noted(
    part: str, recipe: Recipe, scenes: Path, source: Path, folder: Path, *, bf16: bool = False
) -> list[float]:
    """A part of each step's loss, while the recipe is run."""
    found: list[float] = []
    plain = OutcomeLearner.forward

    def noting(self: OutcomeLearner, places: torch.Tensor) -> dict[str, torch.Tensor]:
        parts = plain(self, places)
        found.append(float(parts[part]))
        return parts

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OutcomeLearner, "forward", noting)
        run(recipe, scenes, source, folder / "rl", RunSettings(folder / "cache", bf16=bf16))
    return found


def test_a_run_draws_as_the_learner_reckons_and_is_logged(
    resampling_checkpoint: Path, tmp_path: Path
) -> None:
    scenes = tmp_path / "scenes"
    write_scenes(scenes / "a.parquet", [training_scene(index) for index in range(6)])
    outcome = OutcomeSettings(draws=3)
    recipe = replace(NANO["cf-rl"], steps=2, batch_size=2, warmup_steps=1, outcome=outcome)
    ratios = noted("policy_ratio", recipe, scenes, resampling_checkpoint, tmp_path)
    # The engine and the learner have one distribution: to the rounding of single precision.
    assert ratios == pytest.approx([1.0, 1.0], abs=1e-4)
    learned = load(tmp_path / "rl")
    [stage] = learned.card.details["stages"]
    assert stage["outcome"]["draws"] == 3
    before = load(resampling_checkpoint).model.state_dict()
    moved = {
        name for name, value in learned.model.state_dict().items() if not torch.equal(value, before[name])
    }
    assert any("language_model" in name for name in moved)
    last = json.loads((tmp_path / "rl" / "log.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 2


def test_a_run_in_bfloat16_draws_in_single_precision(resampling_checkpoint: Path, tmp_path: Path) -> None:
    scenes = tmp_path / "scenes"
    write_scenes(scenes / "a.parquet", [training_scene(index) for index in range(3)])
    recipe = replace(NANO["cf-rl"], steps=1, batch_size=2, warmup_steps=1, outcome=OutcomeSettings(draws=3))
    ratios = noted("policy_ratio", recipe, scenes, resampling_checkpoint, tmp_path, bf16=True)
    assert ratios == pytest.approx([1.0], abs=0.05)


def test_what_is_worth_more_is_drawn_more_often(resampling_checkpoint: Path, tmp_path: Path) -> None:
    """Where nothing counts but the cost of a second look, the branch learns to do without."""
    scenes = tmp_path / "scenes"
    write_scenes(scenes / "a.parquet", [training_scene(index) for index in (1, 2)])
    outcome = OutcomeSettings(draws=8, imitation=0.0, rewards=RewardWeights(0.0, 0.0, 0.0, thinking=1.0))
    recipe = replace(
        NANO["cf-rl"], steps=8, batch_size=2, warmup_steps=0, learning_rate=1e-3, outcome=outcome
    )
    shares = noted("think_rate", recipe, scenes, resampling_checkpoint, tmp_path)
    assert shares[0] > 0.2
    assert shares[-1] < shares[0] / 2
