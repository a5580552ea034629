from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from accelerate.data_loader import BatchSamplerShard

from looktwice.model.training.sampler import Item, TaskSampler


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


REFLECTED = np.array([3, 3, 5], np.int64)


def told(count: int) -> np.ndarray:
    """The route, and no tracks."""
    return np.tile([True, False], (count, 1))


def test_reflections_are_examples_beside_all_others() -> None:
    sampler = TaskSampler(
        np.ones(8, np.bool_),
        1,
        {"cf_vla": 1.0},
        0.5,
        seed=0,
        reflected=REFLECTED,
        told=told(3),
        reflecting="cf_vla",
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
        told=told(3),
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
        told=told(len(reflected)),
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
@pytest.mark.parametrize("examples", [70, 100, 333])
def test_its_length_is_that_of_an_epoch_where_some_have_no_pictures(examples: int, processes: int) -> None:
    """A trainer ends after as many epochs as its steps make by this length."""
    pictured = np.arange(examples) % 3 > 0
    reflected = np.arange(0, examples, 2)
    sampler = TaskSampler(
        np.ones(examples, np.bool_),
        16,
        {"traj_only": 0.3, "cf_vla": 0.7},
        0.8,
        seed=0,
        processes=processes,
        reflected=reflected,
        told=told(len(reflected)),
        reflecting="cf_vla",
        tracks_share=0.5,
        pictured=pictured,
        attempted=np.arange(0, examples, 5),
        attempting="elf_vla_refine",
    )
    for epoch in range(3):
        sampler.set_epoch(epoch)
        batches = list(sampler)
        assert len(batches) == len(sampler)
        assert all(len({item.pictures for item in batch}) == 1 for batch in batches)


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
        told=told(len(reflected)),
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


def test_the_control_learns_the_same_scenes_without_reasoning() -> None:
    sampler = TaskSampler(
        np.ones(8, np.bool_),
        1,
        {"traj_only": 1.0},
        0.5,
        seed=0,
        reflected=REFLECTED,
        told=told(3),
        reflecting="cf_vla",
        reasoning=False,
    )
    items = [item for batch in sampler for item in batch]
    assert {item.reflections for item in items} == {()}
    assert Counter(item.index for item in items if item.task == "cf_vla") == {3: 2, 5: 1}


def test_each_chance_is_taken_as_often_as_asked() -> None:
    sampler = TaskSampler(
        np.ones(4000, np.bool_),
        16,
        {"cf_vla": 1.0},
        0.8,
        seed=0,
        reflected=np.arange(0, 4000, 8),
        told=told(500),
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
    assert not any(item.tracks for item in reflected), "its plan was made without them"
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
    assert abs(sum(item.camera_requested for item in taught) / len(taught) - 0.8) < 0.05
    assert not any(item.camera_requested for item in items if item.camera is None)
    # A picture is a third of a response: those with one share batches.
    mixed = [batch for batch in batches if len({item.camera is None for item in batch}) == 2]
    assert len(mixed) <= 4 < len(batches) / 20


def test_reflections_are_learned_behind_what_their_model_was_told() -> None:
    sampler = TaskSampler(
        np.array([True, True, False]),
        1,
        {"cf_vla": 1.0},
        0.5,
        seed=0,
        reflected=np.array([0, 0, 0, 1, 2]),
        told=np.array([(True, True), (True, False), (True, True), (False, True), (True, False)]),
        reflecting="cf_vla",
        tracks_share=0.5,
        pictured=np.array([True, True, True]),
    )
    items = [item for batch in sampler for item in batch if item.reflections]
    assert {(item.index, item.reflections, item.route, item.tracks) for item in items} == {
        (0, (0, 2), True, True),
        (0, (1,), True, False),
        (1, (3,), False, True),
        (2, (4,), False, False),
    }
    with pytest.raises(ValueError, match="what was told"):
        TaskSampler(
            np.ones(3, np.bool_), 1, {"cf_vla": 1.0}, 0.5, 0, reflected=np.array([0]), reflecting="cf_vla"
        )
