from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from accelerate.data_loader import BatchSamplerShard

from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE
from looktwice.model.driving.trajectory import present_speed
from looktwice.model.families.cf_vla.targets import PAPER_WEIGHTS
from looktwice.model.families.family import Reflection, Situation
from looktwice.model.formats.pieces import FormatError
from looktwice.model.network.checkpoint import Loaded, load
from looktwice.model.network.vocabulary import FUTURE_START, TRACK, VIDEO_PAD
from looktwice.model.training.batches import Sample, collate
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
        reflections=[Reflection(WRONG, text) for text in texts],
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


def test_an_epoch_gives_every_example_at_most_once_with_its_share_of_tasks() -> None:
    has_route = np.arange(4000) % 4 > 0
    sampler = TaskSampler(has_route, 16, {"traj_only": 0.25, "cf_vla": 0.75}, 0.5, seed=0)
    batches = list(sampler)
    items = [item for batch in batches for item in batch]
    assert len(batches) == len(sampler) == 250
    assert max(Counter(item.index for item in items).values()) == 1
    tasks = Counter(item.task for item in items)
    assert tasks["cf_vla"] / len(items) == pytest.approx(0.75, abs=0.03)
    assert sum(item.route for item in items) / len(items) == pytest.approx(0.375, abs=0.03)
    assert not any(item.route and not has_route[item.index] for item in items)
    mixed = [batch for batch in batches if len({(item.task, item.route) for item in batch}) > 1]
    assert len(mixed) <= 4


def test_epochs_differ_and_repeat_by_seed() -> None:
    def epoch(number: int) -> list[list[Item]]:
        sampler = TaskSampler(np.ones(64, np.bool_), 8, {"cf_vla": 1.0}, 0.5, seed=3)
        sampler.set_epoch(number)
        return list(sampler)

    assert epoch(0) == epoch(0)
    assert epoch(0) != epoch(1)


def test_processes_get_batches_of_one_kind_at_a_time() -> None:
    tasks: dict[str, float] = {"traj_only": 0.5, "cf_vla": 0.5}
    batches = list(TaskSampler(np.ones(4000, np.bool_), 16, tasks, 0.5, seed=0, processes=2))
    kinds = [{(item.task, item.route) for item in batch} for batch in batches]
    alike = [one == two for one, two in zip(kinds[::2], kinds[1::2], strict=True)]
    assert len(batches) == 250
    assert alike.count(False) <= 4


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


def test_learning_without_pictures_leaves_the_tower_alone(loaded: Loaded) -> None:
    data = dataset(loaded, pictures=False)
    learner = ResponseLearner(loaded.model, loaded.vocabulary, loaded.codec)
    loss = learner(**collate([data[Item(1, "cf_vla", False)]]))["loss"]
    loss.backward()
    assert all(parameter.grad is None for parameter in loaded.model.model.visual.parameters())
    assert loaded.model.lm_head.weight.grad is not None
    loaded.model.zero_grad()


REFLECTED = np.array([3, 3, 5], np.int64)


def test_reflections_are_examples_beside_all_others() -> None:
    sampler = TaskSampler(
        np.ones(8, np.bool_), 1, {"cf_vla": 1.0}, 0.5, seed=0, reflected=REFLECTED, reflecting="cf_vla"
    )
    items = [item for batch in sampler for item in batch]
    assert len(items) == len(sampler) == 10
    reflected = [item for item in items if item.reflections]
    assert {(item.index, item.reflections) for item in reflected} == {(3, (0, 1)), (5, (2,))}
    assert sorted(item.index for item in items if not item.reflections) == list(range(8))


@pytest.mark.parametrize("phrases", [True, False])
def test_only_reflections_in_phrases_are_mirrored(phrases: bool) -> None:
    sampler = TaskSampler(
        np.ones(8, np.bool_),
        1,
        {"cf_vla": 1.0},
        0.5,
        seed=0,
        reflected=REFLECTED,
        mirror_share=1.0,
        reflecting="cf_vla",
        mirror_reflected=phrases,
    )
    assert {item.mirror for batch in sampler for item in batch if item.reflections} == {phrases}


def test_every_batch_reaches_a_process() -> None:
    reflected = np.arange(300).repeat(4)
    sampler = TaskSampler(
        np.ones(2000, np.bool_),
        16,
        {"cf_vla": 1.0},
        0.5,
        seed=0,
        processes=2,
        reflected=reflected,
        reflecting="cf_vla",
    )
    sampler.set_epoch(1)
    shards = [list(BatchSamplerShard(sampler, 2, process)) for process in range(2)]
    dealt = [batch for pair in zip(*shards, strict=True) for batch in pair]
    everything = list(sampler)
    assert dealt == everything[: len(dealt)]
    assert len(everything) - len(dealt) <= 1
    assert sum(len(item.reflections) for batch in dealt for item in batch) > 1100


@pytest.mark.parametrize("processes", [1, 2])
def test_batches_of_reflections_lie_among_the_others(processes: int) -> None:
    reflected = np.repeat(np.arange(0, 4000, 4), 3)
    sampler = TaskSampler(
        np.ones(4000, np.bool_),
        16,
        {"cf_vla": 1.0},
        0.5,
        seed=0,
        processes=processes,
        reflected=reflected,
        reflecting="cf_vla",
    )
    batches = list(sampler)
    assert len(batches) == len(sampler) == 250 + 200
    sizes = [len(batch) for batch in batches if batch[0].reflections]
    assert set(sizes) == {5}, "of three responses each"
    first_half = [bool(batch[0].reflections) for batch in batches[: len(batches) // 2]]
    assert 0.3 < sum(first_half) / len(first_half) < 0.6
    kinds = [{(item.route, bool(item.reflections)) for item in batch} for batch in batches]
    alike = [one == two for one, two in zip(kinds[::2], kinds[1::2], strict=True)]
    assert processes == 1 or alike.count(False) <= 4


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

    def learned(batch: list[Sample]) -> tuple[float, torch.Tensor]:
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


def test_the_control_learns_the_same_scenes_without_reasoning() -> None:
    sampler = TaskSampler(
        np.ones(8, np.bool_),
        1,
        {"traj_only": 1.0},
        0.5,
        seed=0,
        reflected=REFLECTED,
        reflecting="cf_vla",
        reasoning=False,
    )
    items = [item for batch in sampler for item in batch]
    assert {item.reflections for item in items} == {()}
    assert Counter(item.index for item in items if item.task == "cf_vla") == {3: 2, 5: 1}


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


def test_each_chance_is_taken_as_often_as_asked() -> None:
    sampler = TaskSampler(
        np.ones(4000, np.bool_),
        16,
        {"cf_vla": 1.0},
        0.8,
        seed=0,
        reflected=np.arange(0, 4000, 8),
        reflecting="cf_vla",
        tracks_share=0.5,
        mirror_share=0.3,
        blur_share=0.1,
    )
    batches = list(sampler)
    items = [item for batch in batches for item in batch]
    for name, share in (("tracks", 0.5), ("mirror", 0.3), ("blur", 0.1)):
        plain = [getattr(item, name) for item in items if not item.reflections]
        assert np.mean(plain) == pytest.approx(share, abs=0.03), name
    reflected = [item for item in items if item.reflections]
    assert not any(item.mirror for item in reflected), "what was said of it names left and right"
    assert 0.3 < np.mean([item.tracks for item in reflected]) < 0.7
    mixed = [batch for batch in batches if len({(item.route, item.tracks) for item in batch}) > 1]
    assert len(mixed) <= 8


def test_examples_that_teach_nothing_are_left_out_of_all_epochs() -> None:
    taught = np.arange(40) % 5 > 0
    sampler = TaskSampler(np.ones(40, np.bool_), 4, {"elf_vla": 1.0}, 0.5, seed=0, taught=taught)
    for epoch in range(2):
        sampler.set_epoch(epoch)
        batches = list(sampler)
        assert len(batches) == len(sampler) == 8
        assert sorted(item.index for batch in batches for item in batch) == np.flatnonzero(taught).tolist()


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


def test_pictures_are_taught_where_there_are_any_and_asked_for_in_most_of_them() -> None:
    cameras = [("back", "front") if index % 2 else () for index in range(4000)]
    sampler = TaskSampler(
        np.ones(4000, np.bool_),
        16,
        {"vla_world": 1.0},
        0.8,
        seed=0,
        next_cameras=cameras,
        picture_share=0.5,
    )
    batches = list(sampler)
    items = [item for batch in batches for item in batch]
    taught = [item for item in items if item.camera is not None]
    assert all(item.index % 2 for item in taught)
    assert abs(len(taught) / len(items) - 0.25) < 0.03
    assert abs(sum(item.camera == "back" for item in taught) / len(taught) - 0.5) < 0.05
    assert abs(sum(item.asked for item in taught) / len(taught) - 0.8) < 0.05
    assert not any(item.asked for item in items if item.camera is None)
    # A picture is a third of a response: those with one share batches.
    mixed = [batch for batch in batches if len({item.camera is None for item in batch}) == 2]
    assert len(mixed) <= 4 < len(batches) / 20
