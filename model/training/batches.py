"""Batches for learning to respond: examples with a task each, padded and stacked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.data import BatchSampler, Dataset, Sampler

from model.driving.images import decode_image
from model.formats.cf_vla import FORMATS
from model.formats.cursor import CompiledFormat
from model.network.codec import TrajectoryCodec
from model.network.inputs import InputBuilder
from model.network.patches import patchify, resize
from model.network.prompts import motion_text
from model.network.vocabulary import Vocabulary
from model.training.examples import Examples
from model.training.soft_codes import SoftCodes
from model.training.targets import Reflection, SectionWeights, Task, make_target

Batch = dict[str, Tensor]

WIDTH_STEP: Final = 16
"""Batches are padded to multiples of this: few shapes, so kernels made for a shape are made few times and
kept in little memory (on CPUs every new shape costs megabytes)."""


@dataclass(frozen=True)
class Item:
    """Which example to learn from, and how; ``reflection`` is the place of one on it, where it has one."""

    index: int
    task: Task
    route: bool
    reflection: int | None = None


@dataclass(frozen=True, eq=False)
class Sample:
    """One example rendered for the network."""

    ids: list[int]
    weights: list[float]
    patches: np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None
    history: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    route: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    code_shares: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    facts: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    future: np.ndarray[tuple[int, ...], np.dtype[np.float32]]


class ResponseDataset(Dataset[Sample]):
    """Renders `Item`s; the items of an epoch come from `TaskSampler`."""

    def __init__(
        self,
        examples: Examples,
        codec: TrajectoryCodec,
        inputs: InputBuilder,
        vocabulary: Vocabulary,
        weights: SectionWeights,
        *,
        pictures: bool,
        reflections: Sequence[Reflection] = (),
        seed: int = 0,
    ) -> None:
        self._examples, self._inputs, self._reflections = examples, inputs, reflections
        self._vectors = codec.vectors(examples.history, examples.future)
        self._soft = SoftCodes(codec, self._vectors)
        self._size = np.float32(np.sqrt((self._vectors**2).sum(axis=1).mean()))
        self._random = np.random.default_rng(seed)
        self._weights, self._pictures, self._vocabulary = weights, pictures, vocabulary
        self._formats = {name: CompiledFormat(FORMATS[name], vocabulary) for name in ("cf_vla", "traj_only")}

    def __len__(self) -> int:
        return len(self._examples)

    def __getitem__(self, item: Item) -> Sample:
        examples, index = self._examples, item.index
        soft = self._soft.draw(self._vectors[index], self._random)
        target = make_target(
            self._formats[item.task],
            examples.plan(index),
            soft.codes.tolist(),
            self._weights,
            None if item.reflection is None else self._reflections[item.reflection],
        )
        prompt = self._prompt(item)
        return Sample(
            ids=prompt + list(target.ids),
            weights=[0.0] * len(prompt) + list(target.weights),
            patches=patchify(self.frames(index), self._inputs.settings) if self._pictures else None,
            history=examples.history[index],
            route=np.nan_to_num(examples.route[index]),
            code_shares=soft.shares,
            facts=examples.facts[index],
            future=self._vectors[index] / self._size,
        )

    def _prompt(self, item: Item) -> list[int]:
        if self._pictures:
            return cast("list[int]", self._inputs.prompt(item.task, route=item.route).ids.tolist())
        # Without pictures nothing but speed counts, and a trajectory's whole example has thirty tokens.
        return list(self._vocabulary.encode(motion_text(route=item.route)))

    def frames(self, index: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        """The pictures of an example, uint8 [cameras x 4, h, w, 3]."""
        cameras, frames = self._examples.picture_spans.shape[1:3]
        return np.stack(
            [
                resize(decode_image(self._examples.picture(index, camera, frame)), self._inputs.settings)
                for camera in range(cameras)
                for frame in range(frames)
            ]
        )


class TaskSampler(BatchSampler):
    """Epochs of batches; a batch has one task, with or without route, so little is padded.

    Reflections are examples of their own beside all others: the natural mixture of CF-VLA section 6.

    Args:
        examples: how many there are, and which have a route.
        batch_size: examples per batch.
        tasks: share of the examples for each task.
        route_share: share of the examples, among those that have one, that are given their route.
        seed: of the order; every epoch has another one.
        processes: so many batches in a row are alike, as those who share the work wait for the slowest.
        reflected: int64 [m], the example that each reflection is on.
        thought: bool [m], which of them have reasoning and so make longer responses; by default all.
        reasoning: whether reflections are learned; otherwise their examples are learned once more without,
            the control "multi-round" of CF-VLA section 4.3.
    """

    def __init__(
        self,
        has_route: npt.NDArray[np.bool_],
        batch_size: int,
        tasks: Mapping[Task, float],
        route_share: float,
        seed: int,
        processes: int = 1,
        reflected: npt.NDArray[np.int64] = np.zeros(0, np.int64),
        thought: npt.NDArray[np.bool_] | None = None,
        reasoning: bool = True,
    ) -> None:
        self._processes, self._reflected, self._reasoning = processes, reflected, reasoning
        self._thought = np.ones(len(reflected), np.bool_) if thought is None else thought
        self._has_route, self.batch_size, self._tasks = has_route, batch_size, tasks
        self._route_share, self._seed, self._epoch = route_share, seed, 0
        # accelerate, sharding batches over processes, reads these two and sets the epoch of `sampler`.
        self.drop_last = True
        self.sampler = cast("Sampler[int]", self)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch's order."""
        self._epoch = epoch

    def __len__(self) -> int:
        return (len(self._has_route) + len(self._reflected)) // self.batch_size

    def __iter__(self) -> Iterator[list[Item]]:  # type: ignore[override]  # items instead of positions
        random = np.random.default_rng((self._seed, self._epoch))
        count = len(self._has_route)
        order = random.permutation(count + len(self._reflected))
        example = np.concatenate([np.arange(count), self._reflected])
        given = self._has_route[example] & (random.random(len(order)) < self._route_share)
        names = list(self._tasks)
        drawn = random.choice(len(names), len(order), p=list(self._tasks.values()))
        buckets: dict[tuple[Task, bool, bool], list[Item]] = {}
        leftover: list[Item] = []
        batches: list[list[Item]] = []
        for place in order:
            reflects = place >= count
            task: Task = "cf_vla" if reflects else names[drawn[place]]
            reflection = int(place) - count if reflects and self._reasoning else None
            thinks = reflection is not None and bool(self._thought[reflection])
            key = (task, bool(given[place]), thinks)
            bucket = buckets.setdefault(key, [])
            bucket.append(Item(int(example[place]), task, key[1], reflection))
            if len(bucket) == self.batch_size * self._processes:
                batches += self._split(buckets.pop(key))
        for bucket in buckets.values():
            leftover += bucket
        yield from (batches + self._split(leftover))[: len(self)]

    def _split(self, items: list[Item]) -> list[list[Item]]:
        return [items[start : start + self.batch_size] for start in range(0, len(items), self.batch_size)]


def collate(samples: list[Sample]) -> Batch:
    """Stack samples, padded on the right with token 0 and weight 0 to a multiple of `WIDTH_STEP`."""
    width = -(-max(len(sample.ids) for sample in samples) // WIDTH_STEP) * WIDTH_STEP
    ids = np.zeros((len(samples), width), np.int64)
    weights = np.zeros((len(samples), width), np.float32)
    mask = np.zeros((len(samples), width), np.int64)
    for row, sample in enumerate(samples):
        ids[row, : len(sample.ids)] = sample.ids
        weights[row, : len(sample.ids)] = sample.weights
        mask[row, : len(sample.ids)] = 1
    batch = {
        "input_ids": torch.from_numpy(ids),
        "attention_mask": torch.from_numpy(mask),
        "loss_weights": torch.from_numpy(weights),
        "history": torch.from_numpy(np.stack([sample.history for sample in samples])),
        "route": torch.from_numpy(np.stack([sample.route for sample in samples])),
        "code_shares": torch.from_numpy(np.stack([sample.code_shares for sample in samples])),
        "facts": torch.from_numpy(np.stack([sample.facts for sample in samples])),
        "futures": torch.from_numpy(np.stack([sample.future for sample in samples])),
    }
    if samples[0].patches is not None:
        batch["patches"] = torch.from_numpy(np.concatenate([sample.patches for sample in samples]))
    return batch
