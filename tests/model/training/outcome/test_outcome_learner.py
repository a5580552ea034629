from __future__ import annotations

import json
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from looktwice.model.driving.feedback_store import write_feedback
from looktwice.model.driving.pdm.judging import SceneJudge
from looktwice.model.driving.perceived import Perceived
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.driving.trajectory import (
    HALF_SECONDS_S,
    TEN_HZ_S,
    FloatArray,
    at_times,
    constant_velocity,
)
from looktwice.model.engines.engine import Draw, PlanRequest
from looktwice.model.families.family import Foreseen
from looktwice.model.families.registry import family_named
from looktwice.model.formats.replay import Decision, decisions
from looktwice.model.network.checkpoint import load
from looktwice.model.network.vla_settings import NANO_SETTINGS
from looktwice.model.training.batches import collate
from looktwice.model.training.outcome.draw_rewards import (
    RewardWeights,
    family_rewards,
    form_reward,
    goal_reward,
    rewards,
)
from looktwice.model.training.outcome.outcome_learner import OutcomeLearner
from looktwice.model.training.recipes import NANO, OutcomeSettings, Recipe, RefineSettings, refining_with
from looktwice.model.training.run import run
from looktwice.model.training.run_settings import RunSettings
from looktwice.model.training.sampler import Item
from tests.checkpoints import write_untrained
from tests.model.driving.drives import MIDDLES_S, agent, labelled_scene
from tests.model.evaluation.fakes import draw_of
from tests.model.training.feedback_rows import feedback_row
from tests.model.training.scenes import training_scene

BRAKES = labelled_scene(np.maximum(0, 12 - 4 * np.maximum(MIDDLES_S, 0)), agents=(agent(26.0, 0.0),))
"""An expert who stops behind a car that stands in its way."""
ACCELERATES = parse_plan(
    "- longitudinal\n  - 0.0s-6.4s: Accelerate\n- lateral\n  - 0.0s-6.4s: Straight\n"
    "- lane\n  - 0.0s-6.4s: Keep Lane\n"
)


def test_who_stops_in_time_is_worth_more_than_who_does_not() -> None:
    straight_on = constant_velocity(BRAKES.scene.history)
    found, _, parts = rewards(SceneJudge(BRAKES), [draw_of(BRAKES.future), draw_of(straight_on)])
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
    found, _, parts = rewards(SceneJudge(BRAKES), [direct, looked], weights)
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
    recipe = replace(NANO["cf-rl"], steps=2, batch_size=2, outcome=outcome)
    # A first step that goes far: what is left of the weights before it would show in the second.
    recipe = replace(recipe, warmup_steps=0, learning_rate=1e-3)
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


def test_draws_serve_several_updates(resampling_checkpoint: Path, two_scenes: Path, tmp_path: Path) -> None:
    recipe = replace(
        NANO["cf-rl"],
        steps=4,
        batch_size=2,
        warmup_steps=0,
        learning_rate=1e-3,
        outcome=OutcomeSettings(draws=8, updates=2),
    )
    drawn: list[int] = []
    plain = OutcomeLearner._drawn_by

    def drawing(self: OutcomeLearner, requests: list[PlanRequest]) -> list[list[Draw]]:
        drawn.append(len(requests))
        return plain(self, requests)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OutcomeLearner, "_drawn_by", drawing)
        ratios = noted("policy_ratio", recipe, two_scenes, resampling_checkpoint, tmp_path)
    assert drawn == [2, 2]
    # Of draws that were made before the last update the network thinks otherwise by now.
    assert ratios[::2] == pytest.approx([1.0, 1.0], abs=1e-4)
    assert all(ratio != pytest.approx(1.0, abs=1e-4) for ratio in ratios[1::2]), ratios


def test_draws_are_not_judged_where_nobody_knows_the_road(
    resampling_checkpoint: Path, tmp_path: Path
) -> None:
    roadless = replace(training_scene(0), drivable=(), lane_map=None)
    write_scenes(tmp_path / "a.parquet", [roadless])
    settings = RunSettings(tmp_path / "cache", bf16=False)
    with pytest.raises(ValueError, match="no scene with pictures tells the road"):
        run(NANO["cf-rl"], tmp_path / "a.parquet", resampling_checkpoint, tmp_path / "no", settings)


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


def test_the_goal_is_worth_what_equation_10_says() -> None:
    away_m = np.array([0.0, 1.99, 2.0, 3.9, 4.0, 5.9, 6.0, 9.9, 10.0, 14.9, 15.0, 99.0], np.float32)
    expected = [1, 1, 0.8, 0.8, 0.6, 0.6, 0.4, 0.4, 0.2, 0.2, 0, 0]
    np.testing.assert_allclose(goal_reward(away_m), expected)


def eight(trajectory: FloatArray) -> Draw:
    """A draw with poses every half a second."""
    poses = at_times(trajectory, TEN_HZ_S, HALF_SECONDS_S)
    return replace(draw_of(poses), times_s=HALF_SECONDS_S, thinking="Road edges: both far.")


def test_eight_poses_are_worth_what_64_are() -> None:
    weights = RewardWeights(outcome=1.0, imitation=0.0, words=0.0, thinking=0.0, goal=1.0, form=1.0)
    straight_on = constant_velocity(BRAKES.scene.history)
    found = rewards(SceneJudge(BRAKES), [eight(BRAKES.future), eight(straight_on)], weights, "v1.1")
    dense = rewards(SceneJudge(BRAKES), [draw_of(BRAKES.future), draw_of(straight_on)], version="v1.1")
    np.testing.assert_allclose(found.outcome, dense.outcome, atol=0.05)
    assert found.total[0] == pytest.approx(found.outcome[0] + 2.0)
    # It collides, and ends 30 m behind where the expert stops.
    assert found.total[1] == pytest.approx(1.0)
    assert (found.parts["form"], found.parts["goal"]) == (1.0, 0.5)


def test_form_is_a_half_for_thoughts_and_a_half_for_poses() -> None:
    draw = eight(BRAKES.future)
    assert form_reward(draw) == 1.0
    assert form_reward(replace(draw, thinking=None)) == 0.5
    assert form_reward(replace(draw, trajectory=draw.trajectory[:7])) == 0.5


ELF = ("elf_vla", "elf_vla_refine")


def elf_recipe(**outcome: Any) -> Recipe:
    recipe = NANO["elf-rl"]
    assert recipe.outcome is not None
    settings = replace(recipe.outcome, **{"draws": 3, "updates": 1} | outcome)
    return replace(recipe, steps=2, batch_size=2, warmup_steps=1, outcome=settings)


@pytest.fixture
def two_scenes(tmp_path: Path) -> Path:
    write_scenes(tmp_path / "scenes" / "a.parquet", [training_scene(index) for index in (1, 2)])
    return tmp_path / "scenes"


def test_failed_drafts_are_refined_by_feedback_and_learned_as_first_answers(
    refining_checkpoint: Path, two_scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[list[PlanRequest], list[list[Draw]]]] = []
    prompts: list[int] = []
    plain_draws, plain_policy = OutcomeLearner._drawn_by, OutcomeLearner._policy

    def drawing(self: OutcomeLearner, requests: list[PlanRequest]) -> list[list[Draw]]:
        found = plain_draws(self, requests)
        calls.append((requests, found))
        return found

    def learning(self: OutcomeLearner, answers: Any) -> Any:
        prompts.extend(len(sample.prompt) for sample in answers.samples)
        assert [len(each) for each in answers.worth] == [4, 4]
        assert [each.sum().item() for each in answers.worth] == pytest.approx([0, 0], abs=1e-5)
        return plain_policy(self, answers)

    monkeypatch.setattr(OutcomeLearner, "_drawn_by", drawing)
    monkeypatch.setattr(OutcomeLearner, "_policy", learning)
    scenes = [training_scene(index) for index in (1, 2)]
    # Untrained drafts end anywhere, and none of them is good enough for this threshold.
    recipe = elf_recipe(refining=RefineSettings(ELF[1], threshold=1.1))
    ratios = noted("policy_ratio", recipe, two_scenes, refining_checkpoint, tmp_path)
    # Thoughts and poses are drawn by the distribution that is learned.
    assert ratios == pytest.approx([1.0, 1.0], abs=1e-4)
    assert [{asked.format for asked in requests} for requests, _ in calls] == [{ELF[0]}, {ELF[1]}] * 2
    assert {asked.controls.n for asked in calls[1][0]} == {1}
    for refined, drafts in zip(calls[1][0], calls[0][1], strict=True):
        assert refined.attempt is not None
        assert "Meta action analysis" in refined.attempt.feedback
        labelled = next(each for each in scenes if each.scene.scene_id == refined.scene.scene_id)
        worst = int(rewards(SceneJudge(labelled), drafts, version="v1.1").outcome.argmin())
        np.testing.assert_array_equal(refined.attempt.trajectory, drafts[worst].trajectory)
    # What is learned stands behind the prompt without feedback.
    loaded = load(refining_checkpoint)
    longest = max(len(loaded.inputs.build(training_scene(k).scene, ELF[0]).prompt.ids) for k in (1, 2))
    assert max(prompts) <= longest + 20
    [stage] = load(tmp_path / "rl").card.details["stages"]
    assert stage["outcome"]["refining"]["gamma"] == 0.1


def test_numbers_of_least_error_are_not_learned_from(
    refining_checkpoint: Path, two_scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Thoughts alone are the policy then, and each draw's poses are those that its thoughts lead to."""
    learned: list[tuple[list[float], int]] = []
    plain = OutcomeLearner._drawn

    def learning(self: OutcomeLearner, draw: Draw) -> list[Decision]:
        found = plain(self, draw)
        books = chain.from_iterable(self._loaded.vocabulary.alphabets.values())
        numbers = set(chain.from_iterable(books))
        assert not any(numbers & set(each.ids.tolist()) for each in found)
        learned.append(([draw.logprobs[each.position] or 0.0 for each in found], len(draw.ids)))
        return found

    monkeypatch.setattr(OutcomeLearner, "_drawn", learning)
    recipe = refining_with(elf_recipe(numbers="least_error"), threshold=0.0)
    ratios = noted("policy_ratio", recipe, two_scenes, refining_checkpoint, tmp_path)
    assert ratios == pytest.approx([1.0, 1.0], abs=1e-4)
    assert all(0 < len(decided) < length for decided, length in learned)


def test_below_no_threshold_nothing_is_refined_and_nobody_needs_to_refine(
    resampling_checkpoint: Path, two_scenes: Path, tmp_path: Path
) -> None:
    recipe = refining_with(elf_recipe(), threshold=0.0)
    assert noted("refined_rate", recipe, two_scenes, resampling_checkpoint, tmp_path) == [0.0, 0.0]
    assert ELF[1] not in load(tmp_path / "rl").card.formats
    with pytest.raises(ValueError, match="recipe cf-rl refines no draws"):
        refining_with(NANO["cf-rl"], threshold=0.5)


def test_half_of_the_scenes_are_those_whose_answers_failed(
    resampling_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes, file = tmp_path / "scenes", tmp_path / "feedback.parquet"
    write_scenes(scenes / "a.parquet", [training_scene(index) for index in range(4)])
    write_feedback(file, [feedback_row("scene-0", correct=True), feedback_row("scene-2")])
    learned: list[int] = []
    plain = OutcomeLearner._answered

    def answering(self: OutcomeLearner, places: torch.Tensor) -> Any:
        learned.extend(places.tolist())
        return plain(self, places)

    monkeypatch.setattr(OutcomeLearner, "_answered", answering)
    # Six places: an epoch.
    recipe = replace(refining_with(elf_recipe(), threshold=0.0), steps=3)
    settings = RunSettings(tmp_path / "cache", bf16=False)
    run(recipe, scenes, resampling_checkpoint, tmp_path / "rl", settings, failures=file)
    assert sorted(learned) == [0, 1, 2, 2, 2, 3]
    assert load(tmp_path / "rl").card.details["stages"][-1]["failed_scenes_count"] == 1
    write_feedback(file, [feedback_row("scene-0", correct=True)])
    with pytest.raises(ValueError, match="no answer in a scene that can be learned from is wrong"):
        run(recipe, scenes, resampling_checkpoint, tmp_path / "no", settings, failures=file)


def test_feedback_by_rule_is_the_verdict_and_what_the_expert_did(
    refining_checkpoint: Path, two_scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: dict[str, str] = {}
    plain = OutcomeLearner._drawn_by

    def drawing(self: OutcomeLearner, requests: list[PlanRequest]) -> list[list[Draw]]:
        told.update((each.scene.scene_id, each.attempt.feedback) for each in requests if each.attempt)
        return plain(self, requests)

    monkeypatch.setattr(OutcomeLearner, "_drawn_by", drawing)
    recipe = refining_with(
        replace(elf_recipe(refining=RefineSettings(ELF[1], threshold=1.1)), steps=1), feedback="rule"
    )
    noted("refined_rate", recipe, two_scenes, refining_checkpoint, tmp_path)
    assert len(told) == 2
    for scene in (training_scene(index) for index in (1, 2)):
        text = told[scene.scene.scene_id]
        end = scene.future[39]
        assert text.startswith("The driving score is ")
        assert "Meta action" not in text
        assert text.endswith(f"[{end[0]:.2f}, {end[1]:.2f}].")
    [stage] = load(tmp_path / "rl").card.details["stages"]
    assert stage["outcome"]["refining"]["feedback"] == "rule"


def test_who_cannot_refine_is_refused(resampling_checkpoint: Path, two_scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"does not write elf_vla_refine.*--failures` teaches it"):
        run(elf_recipe(), two_scenes, resampling_checkpoint, tmp_path / "no", RunSettings(tmp_path / "cache"))


@pytest.mark.parametrize("injected", [True, False])
def test_an_answer_that_only_feedback_leads_to_becomes_likelier(
    injected: bool,
    refining_checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing but the expert's end counts, which untrained drafts miss by far."""
    likely: list[float] = []

    def refined(
        self: OutcomeLearner, items: list[Item], judges: Any, draws: list[list[Draw]], judged: Any
    ) -> Any:
        found = []
        for item, own in zip(items, draws, strict=True):
            sample = self._data[item]
            [expert] = sample.responses
            made = decisions(self._data.formats[item.task].start(), expert.ids)
            with torch.no_grad():
                [now] = self.learner.log_probabilities(collate([sample]), [made], 1.2)
            likely.append(float(now.sum()))
            future = self._scenes[item.index].future
            found.append([replace(own[0], ids=expert.ids, trajectory=eight(future).trajectory)])
        return found if injected else [[] for _ in items]

    monkeypatch.setattr(OutcomeLearner, "_refined", refined)
    write_scenes(tmp_path / "scenes" / "a.parquet", [training_scene(1)])
    weights = RewardWeights(outcome=0.0, imitation=0.0, words=0.0, thinking=0.0, goal=1.0)
    # An untrained network gives each of a number's tokens less than a thousandth.
    refining = RefineSettings(ELF[1], gamma=1e-3)
    recipe = elf_recipe(imitation=0.0, rewards=weights, refining=refining)
    recipe = replace(recipe, steps=8, batch_size=1, warmup_steps=0, learning_rate=1e-3)
    worths = noted("goal", recipe, tmp_path / "scenes", refining_checkpoint, tmp_path)
    assert max(worths) < 0.5
    gained = likely[-1] - likely[0]
    assert gained > 10 if injected else gained < 2


def test_imagining_responses_are_learned_from_their_own_rewards(two_scenes: Path, tmp_path: Path) -> None:
    settings = replace(NANO_SETTINGS, formats=("vla_world",))
    source = write_untrained(tmp_path / "untrained", narrow=True, settings=settings)
    recipe = NANO["world-rl"]
    assert recipe.outcome is not None
    recipe = replace(recipe, steps=2, batch_size=2, outcome=replace(recipe.outcome, draws=2))
    # A first step that goes far: what has gone from the start shows in the second.
    recipe = replace(recipe, warmup_steps=0, learning_rate=1e-3)
    ratios = noted("policy_ratio", recipe, two_scenes, source, tmp_path)
    assert ratios == pytest.approx([1.0, 1.0], abs=1e-4)
    apart = noted("divergence", recipe, two_scenes, source, tmp_path / "again")
    assert apart[0] == pytest.approx(0, abs=1e-6)
    assert apart[1] > 1e-4
    [stage] = load(tmp_path / "rl").card.details["stages"]
    assert stage["outcome"]["rewards"] == {"prediction": 1.0, "action": 1.0, "waypoints": 1.0}
    torch.testing.assert_close(
        load(tmp_path / "rl").model.lm_head.weight, load(tmp_path / "again" / "rl").model.lm_head.weight
    )


def test_rewards_that_a_family_does_not_have_are_refused() -> None:
    draw = draw_of(BRAKES.future)
    with pytest.raises(ValueError, match="elf_vla has no rewards of its own"):
        family_rewards(family_named("elf_vla"), BRAKES.future, [draw], {"action": 1.0})
    seen = Foreseen(Perceived((), 1.0, 1.0), 5.0, 0.0, "Forward", None)
    draw = replace(draw, trajectory=draw.trajectory[4:30:5], foreseen=seen, action=("forward", "keep"))
    with pytest.raises(ValueError, match="rewards are prediction, action, waypoints, and action are"):
        family_rewards(family_named("vla_world"), BRAKES.future, [draw], {"action": 1.0})
    weights = {"prediction": 0.0, "action": 2.0, "waypoints": 0.0}
    found = family_rewards(family_named("vla_world"), BRAKES.future, [draw], weights)
    # It stops, and says that it keeps its speed.
    assert found.total == pytest.approx([1.0])
    assert found.parts["action"] == 0.5


def test_one_scene_that_is_half_learned_is_answered_better_and_better(tmp_path: Path) -> None:
    """Overfitting, as small as it goes: a response is imitated a little, then learned from rewards."""
    settings = replace(NANO_SETTINGS, formats=ELF[:1])
    source = write_untrained(tmp_path / "untrained", narrow=True, settings=settings)
    write_scenes(tmp_path / "scenes" / "a.parquet", [training_scene(2)])
    alone: dict[str, Any] = {"batch_size": 1, "warmup_steps": 0, "route_share": 1.0, "tracks_share": 0.0}
    imitating = replace(
        NANO["elf-sft"], steps=60, learning_rate=3e-3, mirror_share=0.0, blur_share=0.0, **alone
    )
    run(imitating, tmp_path / "scenes", source, tmp_path / "sft", RunSettings(tmp_path / "cache"))
    recipe = refining_with(elf_recipe(imitation=0.0), threshold=0.0)
    assert recipe.outcome is not None
    recipe = replace(recipe, outcome=replace(recipe.outcome, draws=16))
    recipe = replace(recipe, steps=12, learning_rate=2e-3, **alone)
    found = noted("reward", recipe, tmp_path / "scenes", tmp_path / "sft", tmp_path)
    # It gains 0.38 of 2, as 1 of 3 is for the form; draws of 16 differ by 0.07 from step to step.
    assert np.mean(found[-4:]) > np.mean(found[:2]) + 0.15
