from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.driving.trajectory import present_speed
from looktwice.model.families.cf_vla.targets import PAPER_WEIGHTS
from looktwice.model.families.family import Counterfactual, Situation
from looktwice.model.formats.pieces import FormatError
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.network.vocabulary import FUTURE_START, TRACK, VIDEO_PAD
from looktwice.model.training.batches import ResponseSample, collate
from looktwice.model.training.examples import Examples
from looktwice.model.training.learner import ResponseLearner
from looktwice.model.training.responses import ResponseDataset
from looktwice.model.training.sampler import Item, TaskSampler
from tests.model.training.scenes import training_scene


@pytest.fixture(scope="module")
def loaded(untrained_checkpoint: Path) -> Loaded:
    return load(untrained_checkpoint)


WRONG = parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")
EXAMPLES = Examples.from_scenes((training_scene(k) for k in range(8)), (FRONT_WIDE, FRONT_TELE))


def dataset(loaded: Loaded, *texts: str, pictures: bool = True) -> ResponseDataset:
    """With a reflection on `WRONG` for each text."""
    return ResponseDataset(
        EXAMPLES,
        loaded.codec,
        loaded.inputs,
        loaded.vocabulary,
        PAPER_WEIGHTS,
        pictures=pictures,
        reflections=[Counterfactual(WRONG, text) for text in texts],
    )


def test_a_reflection_that_cannot_be_written_is_refused_before_training(loaded: Loaded) -> None:
    with pytest.raises(FormatError, match="no allowed token"):
        dataset(loaded, "The car ahead stands.", "\u524d\u306e\u8eca")


@pytest.mark.parametrize(
    ("texts", "branches"),
    [((), True), (("The car ahead stands.",), True), (("",), True), (("The car ahead stands.", ""), False)],
)
def test_the_expert_branches_unless_plans_of_both_kinds_were_judged(
    loaded: Loaded, texts: tuple[str, ...], branches: bool
) -> None:
    alone, beside = (
        dataset(loaded, *each)[Item(0, "cf_vla", route=True)].responses[0] for each in ((), texts)
    )
    assert beside.ids == alone.ids
    untaught = [one for one, other in zip(alone.weights, beside.weights, strict=True) if other != one]
    assert untaught == ([] if branches else [10.0])  # one token decides


def test_only_the_response_weighs(loaded: Loaded) -> None:
    sample = dataset(loaded)[Item(1, "cf_vla", True)]
    situation = Situation(EXAMPLES.history[1], EXAMPLES.route[1])
    prompt = loaded.inputs.prompt("cf_vla", situation).ids.tolist()
    assert sample.prompt == prompt
    batch = collate([sample])
    (response,) = sample.responses
    weights = batch["loss_weights"][0].tolist()
    assert batch["input_ids"][0, : len(prompt) + len(response.ids)].tolist() == prompt + list(response.ids)
    assert set(weights[: len(prompt)]) == {0.0}
    assert min(weights[len(prompt) : len(prompt) + len(response.ids)]) > 0


def test_padding_changes_no_loss(loaded: Loaded) -> None:
    """A batch's loss is the mean of its responses' losses: padding and neighbours do not matter."""
    data = dataset(loaded)
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec)
    samples = [data[Item(1, "cf_vla", True)], data[Item(2, "traj_only", False)]]
    with torch.no_grad():
        alone = [float(learner(**collate([sample]))["loss"]) for sample in samples]
        together = float(learner(**collate(samples))["loss"])
    assert together == pytest.approx(sum(alone) / 2, rel=1e-4)


def test_mixed_precision_does_not_round_what_is_sketched(resampling_checkpoint: Path) -> None:
    """Its tokens are centimetres wide, and bfloat16 tells 20 m to the nearest decimetre."""
    loaded = load(resampling_checkpoint)
    batch = collate([dataset(loaded, pictures=False)[Item(1, "traj_only", True, tracks=True)]])
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec)
    decoder: Any = loaded.model.model.language_model
    fed: list[torch.Tensor] = []
    decoder.register_forward_pre_hook(
        lambda _, args, kwargs: fed.append(kwargs["inputs_embeds"]), with_kwargs=True
    )
    with torch.no_grad():
        for mixed in (False, True):
            with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
                learner(**batch)
    exact, mixed_too = fed
    torch.testing.assert_close(mixed_too, exact, rtol=0, atol=0)


def test_learning_without_pictures_leaves_the_tower_alone(loaded: Loaded) -> None:
    data = dataset(loaded, pictures=False)
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec)
    loss = learner(**collate([data[Item(1, "cf_vla", False)]]))["loss"]
    loss.backward()
    assert all(parameter.grad is None for parameter in loaded.model.model.visual.parameters())
    assert loaded.model.lm_head.weight.grad is not None
    loaded.model.zero_grad()


def test_responses_that_share_a_prompt_do_not_see_each_other(loaded: Loaded) -> None:
    """Their loss is the mean of their losses alone, to the last gradient."""
    texts = ("The road ahead is clear, so I should drive on.", "", "The car ahead has stopped: slow down.")
    data = dataset(loaded, *texts)
    samples = [data[Item(2, "cf_vla", True, (0, 1, 2))], data[Item(4, "cf_vla", False, (1,))]]
    alone = [
        replace(sample, responses=[response], code_shares=shares[None], code_errors_m=errors_m[None])
        for sample in samples
        for response, shares, errors_m in zip(
            sample.responses, sample.code_shares, sample.code_errors_m, strict=True
        )
    ]
    learner = ResponseLearner(
        loaded.model, loaded.vocabulary, loaded.codec, error_weight=0.5, head_weight=0.25
    )

    def learned(batch: list[ResponseSample]) -> tuple[float, torch.Tensor]:
        loaded.model.zero_grad()
        loss = learner(**collate(batch))["loss"]
        loss.backward()
        gradient = loaded.model.lm_head.weight.grad
        assert gradient is not None
        return loss.item(), gradient.clone()

    together, separate = learned(samples), learned(alone)
    loaded.model.zero_grad()
    assert together[0] == pytest.approx(separate[0], rel=1e-5)
    torch.testing.assert_close(together[1], separate[1], rtol=1e-3, atol=1e-6)


def test_a_counterfactual_example_learns_everything_but_the_wrong_plan(loaded: Loaded) -> None:
    data = dataset(loaded, "The road ahead is clear, so I should drive on.")
    (target,) = data[Item(2, "cf_vla", True, (0,))].responses
    response = loaded.vocabulary.decode(target.ids)
    (plain,) = data[Item(2, "cf_vla", True)].responses
    assert str(WRONG) in response
    assert "The road ahead is clear" in response
    assert str(EXAMPLES.plan(2)) in response
    assert response.index(str(WRONG)) < response.index("Thinking:") < response.index(str(EXAMPLES.plan(2)))
    weighed = [token for token, weight in zip(target.ids, target.weights, strict=True) if weight > 0]
    assert loaded.vocabulary.decode(weighed).startswith("Thinking:")
    assert "Wait" not in loaded.vocabulary.decode(weighed)
    assert "Thinking:" not in loaded.vocabulary.decode(plain.ids)


def test_examples_without_pictures_are_learned_by_their_tracks(resampling_checkpoint: Path) -> None:
    pictured = np.arange(len(EXAMPLES)) % 2 == 0
    tasks = {"traj_only": 0.5, "cf_vla": 0.5}
    sampler = TaskSampler(np.ones(len(EXAMPLES), np.bool_), 2, tasks, 0.5, seed=0, pictured=pictured)
    batches = list(sampler)
    for batch in batches:
        assert len({item.pictures for item in batch}) == 1
        for item in batch:
            assert item.pictures == pictured[item.index]
            assert item.pictures or item.tracks
    loaded = load(resampling_checkpoint)
    data = ResponseDataset(
        EXAMPLES, loaded.codec, loaded.inputs, loaded.vocabulary, PAPER_WEIGHTS, pictures=True
    )
    told = data[Item(1, "cf_vla", True, tracks=True, pictures=False)]
    assert told.patches is None
    assert told.responses == data[Item(1, "cf_vla", True, tracks=True)].responses
    video, track = loaded.vocabulary.id_of(VIDEO_PAD), loaded.vocabulary.id_of(TRACK)
    assert video not in told.prompt
    assert track in told.prompt


def test_a_mirrored_example_is_the_example_of_the_mirrored_scene(resampling_checkpoint: Path) -> None:
    loaded = load(resampling_checkpoint)
    data = ResponseDataset(
        EXAMPLES, loaded.codec, loaded.inputs, loaded.vocabulary, PAPER_WEIGHTS, pictures=True
    )
    plain = data[Item(1, "cf_vla", True, tracks=True)]
    swapped = data[Item(1, "cf_vla", True, tracks=True, mirror=True)]
    np.testing.assert_array_equal(swapped.history, plain.history * [1, -1, 1, -1])
    np.testing.assert_array_equal(swapped.future, plain.future * [1, -1, 1, -1])
    np.testing.assert_array_equal(swapped.route, plain.route * [1, -1])
    assert swapped.prompt == plain.prompt
    assert swapped.patches is not None
    assert plain.patches is not None
    assert not np.array_equal(swapped.patches, plain.patches)


def test_a_blurred_history_keeps_nothing_but_the_speed(loaded: Loaded) -> None:
    data = dataset(loaded)
    plain, blurred = data[Item(1, "cf_vla", True)], data[Item(1, "cf_vla", True, blur=True)]
    assert present_speed(blurred.history) == pytest.approx(present_speed(plain.history), rel=1e-4)
    assert not blurred.history[:, 1:].any()
    np.testing.assert_array_equal(blurred.future, plain.future)


def test_the_head_draws_where_the_first_code_is_written(loaded: Loaded) -> None:
    data = dataset(loaded, "The car ahead has stopped: slow down.")
    batch = collate([data[Item(2, "cf_vla", True, (0,))], data[Item(4, "cf_vla", False)]])
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec, head_weight=1.0)
    assert learner.head is not None
    with torch.no_grad():
        learner.head.best.weight.normal_(std=0.1)  # it begins at the same trajectory for everybody
    parts = learner(**batch)
    plain = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec)(**batch)
    assert float(parts["loss"].detach()) > float(plain["loss"].detach())
    # What follows the first code is not seen; another word of the plan is.
    ids = batch["input_ids"]
    start = loaded.vocabulary.id_of(FUTURE_START)
    for row in range(2):
        place = int((ids[row] == start).nonzero()[-1])
        ids[row, place + 1] = loaded.vocabulary.code_ids(0).start
    torch.testing.assert_close(learner(**batch)["head_ade_m"], parts["head_ade_m"])
    ids[0, int((batch["loss_weights"][0] > 0).int().argmax())] = 7
    assert learner(**batch)["head_ade_m"] != parts["head_ade_m"]
