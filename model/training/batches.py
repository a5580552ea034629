"""Prompts with one response or several, padded and stacked for the network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn

from looktwice.model.training.response_targets import Target

Batch = dict[str, Tensor]
Sample = Any
"""A named tuple of arrays: one example."""
Array = np.ndarray[tuple[int, ...], np.dtype[np.float32]]

_EVALUATED: Final = 64
WIDTH_STEP: Final = 16
"""Batches are padded to multiples of this: few shapes, so kernels made for a shape are made few times and
kept in little memory (on CPUs every new shape costs megabytes)."""


@dataclass(frozen=True, eq=False)
class ResponseSample:
    """One prompt and its responses, rendered for the network.

    Attributes:
        prompt: token ids.
        responses: their ids and weights.
        seen: float16 [v, hidden] vision tokens; None without pictures.
        patches: uint8 [p, n], where the tower learns too; else None.
        history, route, tracks, future: of the example, as its `Item` asks for them.
        code_shares, code_errors_m: [responses, stages, size], see `SoftTarget`.
    """

    prompt: list[int]
    responses: list[Target]
    seen: np.ndarray[tuple[int, ...], np.dtype[np.float16]] | None
    patches: np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None
    history: Array
    route: Array
    tracks: Array
    future: Array
    code_shares: Array
    code_errors_m: Array


def collate(samples: list[ResponseSample]) -> Batch:
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
        "tracks": torch.from_numpy(np.stack([sample.tracks for sample in samples])),
        "futures": torch.from_numpy(np.stack([sample.future for sample in samples])),
        "code_shares": torch.from_numpy(np.concatenate([sample.code_shares for sample in samples])),
        "code_errors_m": torch.from_numpy(np.concatenate([sample.code_errors_m for sample in samples])),
    }
    if samples[0].seen is not None:
        batch["seen"] = torch.from_numpy(np.stack([np.asarray(sample.seen) for sample in samples]))
    if samples[0].patches is not None:
        batch["patches"] = torch.from_numpy(np.concatenate([sample.patches for sample in samples]))
    return batch


def stacked(samples: Sequence[Sample]) -> Batch:
    """Samples of one kind as a batch, by the names of their fields."""
    columns = dict(zip(samples[0]._fields, zip(*samples, strict=True), strict=True))
    return {name: torch.from_numpy(np.stack(values)) for name, values in columns.items()}


def mean_values(
    learner: nn.Module, samples: Callable[[int], Sample], places: Sequence[int]
) -> dict[str, float]:
    """What a learner's outputs are on average over the samples of places; it is evaluated meanwhile."""
    was_training, sums = learner.training, dict[str, float]()
    learner.eval()
    with torch.inference_mode():
        for start in range(0, len(places), _EVALUATED):
            some = places[start : start + _EVALUATED]
            for name, value in learner(**stacked([samples(place) for place in some])).items():
                sums[name] = sums.get(name, 0.0) + len(some) * float(value)
    learner.train(was_training)
    return {name: total / len(places) for name, total in sums.items()}
