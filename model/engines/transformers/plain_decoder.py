"""One draw, one token at a time, with a cursor that walks along."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from looktwice.model.engines.engine import PlanRequest
from looktwice.model.engines.engine_requests import drawn_as, leads_to_reflection
from looktwice.model.engines.least_error import least_error
from looktwice.model.engines.logprobs import reported
from looktwice.model.engines.reason_mask import ReasonMask
from looktwice.model.engines.response import Response, SectionText
from looktwice.model.engines.sampling import choose, probabilities, uniform
from looktwice.model.engines.transformers.plain_network import Logits, Network, ReadPrompt, Run
from looktwice.model.families.family import Family
from looktwice.model.formats.cursor import Allowed, Cursor


@dataclass(frozen=True, eq=False)
class Prepared:
    """A request, and what its draws share.

    Attributes:
        request, family: what is asked, and of whom.
        start: where its responses begin.
        prompt: what is asked of the model.
    """

    request: PlanRequest
    family: Family
    start: Cursor
    prompt: ReadPrompt

    @property
    def reason_mask(self) -> ReasonMask | None:
        """What its reflections may state."""
        return self.prompt.reason_mask


@dataclass(frozen=True, eq=False)
class DecodingStep:
    """A token was written.

    Attributes:
        response: so far.
        finished: the section that the token ends, if any.
        logits: [k] of the tokens that the format allowed there; of one alone they mean nothing.
        run: the draw in the network.
    """

    response: Response
    finished: list[SectionText]
    logits: Logits
    run: Run


class PlainDecoder:
    """Writes the draws of requests with one network. Call under `torch.inference_mode`.

    Args:
        network: the checkpoint.
    """

    def __init__(self, network: Network) -> None:
        self._network = network

    def begin(self, request: PlanRequest, family: Family, start: Cursor, inputs: Any) -> Prepared:
        """What all draws of a request share.

        Args:
            request, family: what is asked, and of whom.
            start: where its responses begin.
            inputs: of the network, for this request.
        """
        return Prepared(request, family, start, self._network.begin(request, family, inputs))

    def write(self, asked: Prepared, index: int) -> Iterator[DecodingStep]:
        """Write draw ``index``, token by token."""
        run, response = asked.prompt.run(), Response(asked.start)
        while not response.cursor.done:
            allowed = response.cursor.allowed()
            scores = run.scores(allowed.ids)
            token = self._chosen(asked, response, allowed, scores, index)
            logprob = reported(asked.request.controls, response.cursor, scores, token)
            finished = response.append(token, self._network.vocabulary, logprob)
            yield DecodingStep(response, finished, scores, run)
            run.feed(token)

    def _chosen(
        self, asked: Prepared, response: Response, allowed: Allowed, scores: Logits, index: int
    ) -> int:
        controls = asked.request.controls
        left = self._left(asked, response, allowed, scores)
        expected = self._network.expected_error(allowed, controls)
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
        if asked.prompt.binding is not None:
            bound = asked.prompt.binding.leaves(allowed.ids, response.tokens, family.plans)
            left = left if bound is None else bound
        if asked.reason_mask is not None:
            named = asked.reason_mask.leaves(cursor, response.tokens)
            left = left if named is None else named
        return left
