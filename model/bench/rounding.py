"""How often rounding changes a response, and how close the decisions were where it did."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from looktwice.model.driving.scene import Scene
from looktwice.model.engines.engine import Controls, PlanRequest, Thinking
from looktwice.model.engines.sampling import probabilities, uniform
from looktwice.model.engines.torch.batch import Batch, Feed
from looktwice.model.engines.torch.in_process import draws_of
from looktwice.model.engines.torch.runner import PromptPrefill, PromptRequest, Runner
from looktwice.model.families.registry import family_named
from looktwice.model.network.checkpoint import load

_AT_ONCE = 8
"""Scenes that are decoded together, as in service."""


@dataclass(frozen=True)
class Precision:
    """Responses in one type against those in float64.

    Attributes:
        name: ``float32``, or ``bfloat16`` products.
        responses: how many.
        different: how many of them are not the same, token by token.
        margins: for each of these, how far the random number of the decision where they part lay from
            the next border between two tokens, in probability.
    """

    name: str
    responses: int
    different: int
    margins: tuple[float, ...]


Responses = dict[tuple[str, int], tuple[int, ...]]


def measure(checkpoint: Path, scenes: Sequence[Scene], n: int) -> list[Precision]:
    """Decode ``scenes`` with ``n`` draws each in float64, in float32, and with products in bfloat16.

    Responses are in the checkpoint's first format, without thoughts where it may do without. Numbers and
    codes are drawn, too: of those of least expected error no border between two tokens is known.
    """
    loaded = load(checkpoint, torch.float64)
    format = loaded.card.default_format
    thinking: Thinking = "never" if "never" in family_named(format).thinking_choices else "adaptive"
    controls = Controls(thinking=thinking, n=n, numbers="drawn", codes="drawn")
    requests = [
        PlanRequest(scene.scene_id, scene, format, replace(controls, seed=seed))
        for seed, scene in enumerate(scenes)
    ]
    with torch.inference_mode():
        exact = Runner(loaded, _AT_ONCE * n)
        expected = _decode(exact, requests)
        found = []
        for name, products in (("float32", None), ("bfloat16", torch.bfloat16)):
            runner = Runner(load(checkpoint), _AT_ONCE * n, products=products)
            responses = _decode(runner, requests)
            margins = tuple(_margins(exact, requests, expected, responses))
            found.append(Precision(name, len(expected), len(margins), margins))
    return found


def _decode(runner: Runner, requests: Sequence[PlanRequest]) -> Responses:
    return {
        (name, draw.index): draw.ids for name, draws in draws_of(runner, requests).items() for draw in draws
    }


def _margins(
    exact: Runner, requests: Sequence[PlanRequest], expected: Responses, found: Responses
) -> Iterator[float]:
    for request in requests:
        for draw in range(request.controls.n):
            mine, other = expected[request.request_id, draw], found[request.request_id, draw]
            if mine != other:
                part = next(k for k, (a, b) in enumerate(zip(mine, other, strict=False)) if a != b)
                yield _margin(exact, request, draw, mine[:part])


def _margin(exact: Runner, request: PlanRequest, draw: int, written: Sequence[int]) -> float:
    """How far a draw's random number lies from a border, at the decision behind ``written``."""
    cursor = exact.formats[request.format].start()
    for token in written:
        cursor = cursor.advance(token)
    [prompt] = exact.begin_prompts([PromptRequest(request.scene, request.format, 0)])
    assert isinstance(prompt, PromptPrefill)
    exact.feed_prompts([(prompt, exact.prompt_tokens)])
    feed = Feed(0, prompt, 0, [prompt.last_token, *written], [(len(written), cursor.allowed().ids)])
    [[logits]] = exact.feed(Batch.of([feed], exact.memory()))
    borders = np.cumsum(probabilities(logits, request.controls.temperature))[:-1]
    return float(np.abs(borders - uniform(request.controls.seed, draw, len(written))).min())
