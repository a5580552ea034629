"""LookTwice's own checkpoints for the plain decoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from transformers import DynamicCache

from looktwice.model.engines.binding import binding_of
from looktwice.model.engines.engine import Controls, PlanRequest
from looktwice.model.engines.engine_requests import PictureCodes, inputs_of, painted, prompt_tokens
from looktwice.model.engines.least_error import Expected, LeastError
from looktwice.model.engines.reason_mask import reason_mask_of
from looktwice.model.engines.transformers.plain_network import Logits, ReadPrompt, Run
from looktwice.model.families.family import Family
from looktwice.model.families.registry import families_of
from looktwice.model.formats.cursor import Allowed, CompiledFormat
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.inputs import ModelInputs
from looktwice.model.network.model_card import ModelCard
from looktwice.model.network.visual_codes import Frame
from looktwice.model.network.weights import load_weights


class OwnNetwork:
    """`Network` over a checkpoint of LookTwice.

    Args:
        loaded: the checkpoint.
    """

    def __init__(self, loaded: Loaded) -> None:
        self._loaded, self._model = loaded, _any(loaded.model)
        self.vocabulary, self.codec = loaded.vocabulary, loaded.codec
        self.card = _card(loaded.card)
        self.families = families_of(loaded.card.formats, loaded.settings.reflection)
        self.formats = {
            name: CompiledFormat(family.format, loaded.vocabulary) for name, family in self.families.items()
        }
        self._least_error = LeastError(loaded.codec, loaded.vocabulary)

    def check(self, request: PlanRequest) -> None:
        """It has all that controls may need."""

    def inputs(self, request: PlanRequest) -> tuple[ModelInputs, PictureCodes]:
        """See `Network.inputs`."""
        builder, scene, view = self._loaded.inputs, request.scene, request.controls.view
        inputs = inputs_of(builder, scene, request.format, request.attempt, view)
        return inputs, builder.expected(scene, view)

    def expected_error(self, allowed: Allowed, controls: Controls) -> Expected | None:
        """See `LeastError.expected`."""
        return self._least_error.expected(allowed, controls)

    def begin(self, request: PlanRequest, family: Family, inputs: ModelInputs) -> ReadPrompt:
        """What all draws of a request share; each reads the prompt anew."""
        model, vocabulary = self._model, self.vocabulary
        prompt = model.encode_prompt_embeddings(inputs)
        facts = model.read_facts(prompt.embeddings[inputs.prompt.ids == model.config.video_token_id])
        return ReadPrompt(
            lambda: _OwnRun(model, prompt),
            binding_of(request, self.codec, vocabulary),
            reason_mask_of(request, family, vocabulary, facts),
        )

    def prompt_tokens(self, request: PlanRequest) -> int:
        """See `Engine.prompt_tokens`."""
        return prompt_tokens(self._loaded.inputs, request)

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> Frame:
        """See `Engine.paint`."""
        return painted(self._loaded.visual_codes, request, codes)

    def load_weights(self, folder: Path) -> None:
        """Take the weights and the card of another folder; see `Engine.load_weights`."""
        self.card = _card(load_weights(self._loaded, folder))


class _OwnRun(Run):
    """A token a pass."""

    passes = 0

    def __init__(self, model: Any, prompt: Any) -> None:
        self._model, self._place = model, len(prompt.embeddings) + prompt.position_offset
        self._cache = DynamicCache(config=model.config)
        self._step(inputs_embeds=prompt.embeddings[None], position_ids=prompt.position_ids[:, None])

    def scores(self, ids: npt.NDArray[np.int64]) -> Logits:
        """See `Run.scores`."""
        found: Logits = self._logits[ids]
        return found

    def feed(self, token: int) -> None:
        """See `Run.feed`."""
        self._step(
            input_ids=torch.tensor([[token]]),
            position_ids=torch.full((3, 1, 1), self._place + self.passes),
        )
        self.passes += 1

    def _step(self, **inputs: Any) -> None:
        output = self._model(past_key_values=self._cache, use_cache=True, **inputs)
        self._logits = output.logits[0, -1].double().numpy()


def _card(card: ModelCard) -> ModelCard:
    return replace(card, engine="transformers", deadlines=False)


def _any(model: object) -> Any:
    """The network, whose class `transformers` does not type."""
    return model
