"""An engine's draws as a sample, for learning from what they came to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from looktwice.model.driving.scene import Scene
from looktwice.model.driving.trajectory import FUTURE_STEPS, ROUTE_POINTS
from looktwice.model.engines.engine import Draw
from looktwice.model.network.inputs import InputBuilder
from looktwice.model.network.track_features import track_features
from looktwice.model.training.batches import ResponseSample
from looktwice.model.training.response_targets import Target

_ROW_TOKENS: Final = 1536
"""Of a prompt and the responses behind it: what attention takes grows with the square of a row."""


def rollout(scene: Scene, format: str, draws: Sequence[Draw], inputs: InputBuilder) -> list[ResponseSample]:
    """The prompt that an engine read and what it wrote behind it, see `with_draws`.

    `ResponseLearner.log_probabilities` of it are those that the draws tell. It has no expert's future.

    Raises:
        ImageError: a picture cannot be decoded.
    """
    built = inputs.build(scene, format)
    nothing = np.zeros((0, 0, 0), np.float32)
    prompt = ResponseSample(
        prompt=built.prompt.ids.tolist(),
        responses=[],
        seen=None,
        patches=built.patches,
        history=built.history,
        route=np.zeros((ROUTE_POINTS, 2), np.float32) if built.route is None else built.route,
        tracks=track_features((), None) if built.tracks is None else built.tracks,
        future=np.zeros((FUTURE_STEPS, 4), np.float32),
        code_shares=nothing,
        code_errors_m=nothing,
    )
    return with_draws(prompt, draws)


def with_draws(sample: ResponseSample, draws: Sequence[Draw]) -> list[ResponseSample]:
    """A prompt with what an engine wrote behind it, instead of its own responses; all tokens weigh 1.

    Draws keep their order. Long ones stand behind a prompt of their own.
    """
    rows: list[list[Target]] = []
    left = 0
    for draw in draws:
        if not rows or len(draw.ids) > left:
            rows.append([])
            left = _ROW_TOKENS - len(sample.prompt)
        rows[-1].append(Target(draw.ids, (1.0,) * len(draw.ids)))
        left -= len(draw.ids)
    empty = np.zeros((0, 0, 0), np.float32)
    return [replace(sample, responses=row, code_shares=empty, code_errors_m=empty) for row in rows]
