"""Batches for learning to respond: prompts with one response or several, padded and stacked."""

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
from model.training.targets import Reflection, SectionWeights, Target, Task, make_target

Batch = dict[str, Tensor]

WIDTH_STEP: Final = 16
"""Batches are padded to multiples of this: few shapes, so kernels made for a shape are made few times and
kept in little memory (on CPUs every new shape costs megabytes)."""


@dataclass(frozen=True)
class Item:
    """Which example to learn from, and how.

    Attributes:
        index: of the example.
        task: the response format.
        route: whether the prompt has the example's route.
        reflections: places of reflections on it, whose responses all follow the same prompt; without any,
            the response is the expert's own.
    """

    index: int
    task: Task
    route: bool
    reflections: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Sample:
    """One prompt and its responses, rendered for the network; ``code_shares`` has a row for each response."""

    prompt: list[int]
    responses: list[Target]
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
        reflections: Sequence[Reflection | None] = [self._reflections[place] for place in item.reflections]
        reflections = reflections or [None]
        soft = [self._soft.draw(self._vectors[index], self._random) for _ in reflections]
        return Sample(
            prompt=self._prompt(item),
            responses=[
                make_target(
                    self._formats[item.task],
                    examples.plan(index),
                    drawn.codes.tolist(),
                    self._weights,
                    reflection,
                )
                for drawn, reflection in zip(soft, reflections, strict=True)
            ],
            patches=patchify(self.frames(index), self._inputs.settings) if self._pictures else None,
            history=examples.history[index],
            route=np.nan_to_num(examples.route[index]),
            code_shares=np.stack([drawn.shares for drawn in soft]),
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

    Reflections are examples of their own beside all others: the natural mixture of CF-VLA section 6. Those
    on one scene share its prompt, and scenes with about as many share a batch.

    Args:
        has_route: bool [m], which examples have one; so many there are.
        batch_size: responses per batch; with reflections, about so many.
        tasks: share of the examples for each task.
        route_share: share of the examples, among those that have one, that are given their route.
        seed: of the order; every epoch has another one.
        processes: so many batches in a row are alike, as those who share the work wait for the slowest.
        reflected: int64 [r], the example that each reflection is on.
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
        reasoning: bool = True,
    ) -> None:
        self._processes, self._has_route, self._tasks = processes, has_route, tasks
        self._route_share, self._seed, self._epoch = route_share, seed, 0
        self._again = np.zeros(0, np.int64) if reasoning else reflected
        self._reflections: dict[int, list[int]] = {}
        for place, index in enumerate(reflected if reasoning else ()):
            self._reflections.setdefault(int(index), []).append(place)
        mean = len(reflected) / max(1, len(self._reflections))
        self._scenes_a_batch = max(1, round(batch_size / max(1.0, mean)))
        self._batch_size = batch_size
        # accelerate, sharding batches over processes, reads these three and sets the epoch of `sampler`. With
        # a number here it would leave out all batches of another length, which those of reflections have.
        self.batch_size, self.drop_last = None, True  # type: ignore[assignment]  # torch's stubs know no None
        self.sampler = cast("Sampler[int]", self)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch's order."""
        self._epoch = epoch

    def __len__(self) -> int:
        plain = len(self._has_route) + len(self._again)
        return plain // self._batch_size + len(self._reflections) // self._scenes_a_batch

    def __iter__(self) -> Iterator[list[Item]]:  # type: ignore[override]  # items instead of positions
        random = np.random.default_rng((self._seed, self._epoch))
        plain, plain_rest = self._rounds(self._plain(random), self._batch_size)
        reflected, reflected_rest = self._rounds(self._reflected(random), self._scenes_a_batch)
        rounds = plain + reflected
        for place in random.permutation(len(rounds)):
            yield from rounds[place]
        yield from plain_rest + reflected_rest

    def _plain(self, random: np.random.Generator) -> list[Item]:
        """The expert's own responses, in a new order; those on ``again`` with a plan."""
        count = len(self._has_route)
        example = np.concatenate([np.arange(count), self._again])
        names = list(self._tasks)
        drawn = random.choice(len(names), len(example), p=list(self._tasks.values()))
        given = self._given(example, random)
        return [
            Item(int(example[place]), names[drawn[place]] if place < count else "cf_vla", bool(given[place]))
            for place in random.permutation(len(example))
        ]

    def _reflected(self, random: np.random.Generator) -> list[Item]:
        example = np.array(list(self._reflections), np.int64)
        given = self._given(example, random)
        return [
            Item(index, "cf_vla", bool(given[place]), tuple(self._reflections[index]))
            for place in random.permutation(len(example))
            for index in [int(example[place])]
        ]

    def _given(self, example: npt.NDArray[np.int64], random: np.random.Generator) -> npt.NDArray[np.bool_]:
        chosen: npt.NDArray[np.bool_] = random.random(len(example)) < self._route_share
        return self._has_route[example] & chosen

    def _rounds(self, items: list[Item], size: int) -> tuple[list[list[list[Item]]], list[list[Item]]]:
        """Batches of like items, as many in a round as there are processes; and batches of the rest."""
        rounds: list[list[list[Item]]] = []
        buckets: dict[tuple[Task, bool, int], list[Item]] = {}
        for item in items:
            key = (item.task, item.route, len(item.reflections))
            bucket = buckets.setdefault(key, [])
            bucket.append(item)
            if len(bucket) == size * self._processes:
                rounds.append(_split(buckets.pop(key), size))
        rest = [item for key in sorted(buckets) for item in buckets[key]]
        return rounds, _split(rest, size)[: len(rest) // size]


def _split(items: list[Item], size: int) -> list[list[Item]]:
    return [items[start : start + size] for start in range(0, len(items), size)]


def collate(samples: list[Sample]) -> Batch:
    """Stack samples, padded on the right to a multiple of `WIDTH_STEP`.

    ``parts`` says what a token belongs to: 0 the prompt, k its k-th response, -1 padding.
    """
    longest = max(
        len(sample.prompt) + sum(len(response.ids) for response in sample.responses) for sample in samples
    )
    width = -(-longest // WIDTH_STEP) * WIDTH_STEP
    ids = np.zeros((len(samples), width), np.int64)
    weights = np.zeros((len(samples), width), np.float32)
    parts = np.full((len(samples), width), -1, np.int64)
    for row, sample in enumerate(samples):
        end = len(sample.prompt)
        ids[row, :end], parts[row, :end] = sample.prompt, 0
        for part, response in enumerate(sample.responses, start=1):
            place = slice(end, end + len(response.ids))
            ids[row, place], weights[row, place], parts[row, place] = response.ids, response.weights, part
            end = place.stop
    batch = {
        "input_ids": torch.from_numpy(ids),
        "parts": torch.from_numpy(parts),
        "loss_weights": torch.from_numpy(weights),
        "history": torch.from_numpy(np.stack([sample.history for sample in samples])),
        "route": torch.from_numpy(np.stack([sample.route for sample in samples])),
        "code_shares": torch.from_numpy(np.concatenate([sample.code_shares for sample in samples])),
        "facts": torch.from_numpy(np.stack([sample.facts for sample in samples])),
        "futures": torch.from_numpy(np.stack([sample.future for sample in samples])),
    }
    if samples[0].patches is not None:
        batch["patches"] = torch.from_numpy(np.concatenate([sample.patches for sample in samples]))
    return batch
