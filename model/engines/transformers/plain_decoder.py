"""One draw, one token at a time, with a cursor that walks along."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from transformers import DynamicCache

from looktwice.model.engines.binding import Binding, binding_of
from looktwice.model.engines.engine import PlanRequest
from looktwice.model.engines.engine_requests import drawn_as, leads_to_reflection
from looktwice.model.engines.least_error import LeastError, least_error
from looktwice.model.engines.logprobs import reported
from looktwice.model.engines.reason_mask import ReasonMask, reason_mask_of
from looktwice.model.engines.response import Response, SectionText
from looktwice.model.engines.sampling import choose, probabilities, uniform
from looktwice.model.families.family import Family
from looktwice.model.formats.cursor import Allowed, Cursor
from looktwice.model.network.checkpoint import Loaded
from looktwice.model.network.inputs import ModelInputs

Logits = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prepared:
    """A request, and what its draws share.

    Attributes:
        request, family: what is asked, and of whom.
        start: where its responses begin.
        inputs: of the network.
        binding, reason_mask: what its controls leave, where they narrow it.
    """

    request: PlanRequest
    family: Family
    start: Cursor
    inputs: ModelInputs
    binding: Binding | None
    reason_mask: ReasonMask | None


@dataclass(frozen=True, eq=False)
class DecodingStep:
    """A token was written.

    Attributes:
        response: so far.
        finished: the section that the token ends, if any.
        logits: [k] of the tokens that the format allowed there.
    """

    response: Response
    finished: list[SectionText]
    logits: Logits


class PlainDecoder:
    """Writes the draws of requests with one network. Call under `torch.inference_mode`.

    Args:
        loaded: the checkpoint.
    """

    def __init__(self, loaded: Loaded) -> None:
        self._loaded, self._model = loaded, _any(loaded.model)
        self._least_error = LeastError(loaded.codec, loaded.vocabulary)

    def begin(self, request: PlanRequest, family: Family, start: Cursor, inputs: ModelInputs) -> Prepared:
        """What all draws of a request share.

        Args:
            request, family: what is asked, and of whom.
            start: where its responses begin.
            inputs: of the network, for this request.
        """
        loaded = self._loaded
        prompt = self._model.encode_prompt_embeddings(inputs)
        video = self._model.config.video_token_id
        facts = self._model.read_facts(prompt.embeddings[inputs.prompt.ids == video])
        reason_mask = reason_mask_of(request, family, loaded.vocabulary, facts)
        binding = binding_of(request, loaded.codec, loaded.vocabulary)
        return Prepared(request, family, start, inputs, binding, reason_mask)

    def write(self, asked: Prepared, index: int) -> Iterator[DecodingStep]:
        """Write draw ``index``, token by token, from a prompt of its own."""
        model, prompt = self._model, self._model.encode_prompt_embeddings(asked.inputs)
        cache = DynamicCache(config=model.config)
        logits = model(
            inputs_embeds=prompt.embeddings[None],
            position_ids=prompt.position_ids[:, None],
            past_key_values=cache,
            use_cache=True,
        ).logits[0, -1]
        response = Response(asked.start)
        while not response.cursor.done:
            allowed = response.cursor.allowed()
            scores = logits.double().numpy()[allowed.ids]
            token = self._chosen(asked, response, allowed, scores, index)
            logprob = reported(asked.request.controls, response.cursor, scores, token)
            place = len(asked.inputs.prompt.ids) + len(response.tokens)
            finished = response.append(token, self._loaded.vocabulary, logprob)
            yield DecodingStep(response, finished, scores)
            logits = model(
                input_ids=torch.tensor([[token]]),
                position_ids=torch.full((3, 1, 1), place + prompt.position_offset),
                past_key_values=cache,
                use_cache=True,
            ).logits[0, -1]

    def _chosen(
        self, asked: Prepared, response: Response, allowed: Allowed, scores: Logits, index: int
    ) -> int:
        controls = asked.request.controls
        left = self._left(asked, response, allowed, scores)
        expected = self._least_error.expected(allowed, controls)
        if expected is not None:
            return int(allowed.ids[least_error(scores, expected, left)])
        [draw] = drawn_as(asked.request, asked.family, response.cursor, (index,))
        number = np.array([uniform(controls.seed, draw, len(response.tokens))])
        place = choose(scores[left], controls.temperature, controls.top_p, number)[0]
        return int(allowed.ids[left][place])

    def _left(
        self, asked: Prepared, response: Response, allowed: Allowed, scores: Logits
    ) -> npt.NDArray[np.bool_]:
        """Which of the allowed tokens the request's controls leave; notes the think probability."""
        controls, family, cursor = asked.request.controls, asked.family, response.cursor
        left = np.ones(len(allowed.ids), np.bool_)
        branch = family.branch
        if branch is not None and allowed.choice == branch.name and len(allowed.ids) > 1:
            thinks = np.array([leads_to_reflection(branch, cursor, int(id)) for id in allowed.ids])
            response.think_probability = float(probabilities(scores)[thinks].sum())
            decided = controls.second_look(response.think_probability)
            if decided is not None:
                left = thinks == decided
        if asked.binding is not None:
            bound = asked.binding.leaves(allowed.ids, response.tokens, family.plans)
            left = left if bound is None else bound
        if asked.reason_mask is not None:
            named = asked.reason_mask.leaves(cursor, response.tokens)
            left = left if named is None else named
        return left


def _any(model: object) -> Any:
    """The network, whose class `transformers` does not type."""
    return model
