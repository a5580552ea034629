"""One request to vLLM: its draws, the vLLM requests that write them, the events that this gives."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping, Sequence
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from looktwice.model.engines.engine import (
    MAX_DRAWS,
    DrawFinished,
    EngineError,
    Event,
    PlanRequest,
    Started,
)
from looktwice.model.engines.engine_requests import events_of, leads_to_reflection, read
from looktwice.model.engines.least_error import Expected, LeastError, least_error
from looktwice.model.engines.logprobs import reported
from looktwice.model.engines.reason_mask import ReasonMask
from looktwice.model.engines.response import Response, SectionText
from looktwice.model.families.family import Branch, Family
from looktwice.model.formats.cursor import Allowed, Cursor
from looktwice.model.network.checkpoint import Parts

IntArray = npt.NDArray[np.int64]

_SEEDS: Final = 2**63
_MOST_NAMED: Final = 128
"""Tokens that vLLM tells the log-probabilities of by name; of more it tells the whole vocabulary's."""
_FAR: Final = 700.0
"""A difference of log-probabilities beyond which the exponential overflows."""


def seed_of(seed: int, draw: int, written: int) -> int:
    """The seed for vLLM to write on with, from ``draw`` on, behind so many tokens.

    vLLM gives the i-th of n draws this seed plus i, so seeds are spread: otherwise the draws of neighbouring
    seeds were mostly the same, and draws that go on apart repeated the random numbers of their beginnings.
    """
    spread = np.random.SeedSequence([seed % _SEEDS, draw, written]).generate_state(1, np.uint64)
    return int(spread[0]) % (_SEEDS - MAX_DRAWS)


class VllmPrompt(NamedTuple):
    """A scene as vLLM takes it: token ids with one placeholder an item, and the items."""

    ids: list[int]
    data: dict[str, Any]

    def then(self, written: Sequence[int]) -> dict[str, Any]:
        """The prompt with what is written behind it."""
        return {"prompt_token_ids": [*self.ids, *written], "multi_modal_data": self.data}


@dataclass(eq=False)
class _Walk(Response):
    """A draw, walked along with vLLM; every token that vLLM writes is a pass."""

    index: int
    passes: int = 0


class Decoding:
    """Decodes one request; used once.

    Args:
        llm: a running ``AsyncLLM``.
        parts: of the checkpoint that it runs.
        grammar: what may follow a cursor, for vLLM.
        request: what is asked.
        family: of the response.
        least_error: tells how far apart numbers and codes lie.
        reason_mask: what reflections may name; None for anything.
    """

    def __init__(
        self,
        llm: Any,
        parts: Parts,
        grammar: Callable[[Cursor], str],
        request: PlanRequest,
        family: Family,
        least_error: LeastError,
        reason_mask: ReasonMask | None = None,
    ) -> None:
        self._llm, self._parts, self._grammar = llm, parts, grammar
        self._request, self._family = request, family
        self._least_error, self._reason_mask = least_error, reason_mask
        self._happened: asyncio.Queue[Event | Exception] = asyncio.Queue()
        self._tasks: set[asyncio.Task[None]] = set()
        self._requests = 0

    @property
    def draws(self) -> int:
        """How many are asked for."""
        return self._request.controls.n

    async def events(self, prompt: VllmPrompt, start: Cursor) -> AsyncGenerator[Event]:
        """What happens, up to the last `DrawFinished`; closing it early frees everything.

        Args:
            prompt: of the request.
            start: where its responses begin.
        """
        self._prompt = prompt
        draws = [_Walk(start, index) for index in range(self._request.controls.n)]
        try:
            # vLLM keeps its queue to itself.
            yield Started()
            for draw in draws:
                self._tell(draw, draw.append_forced(self._parts.vocabulary))
            self._go_on(draws)
            left = len(draws)
            while left:
                happened = await self._happened.get()
                if isinstance(happened, Exception):
                    raise happened
                left -= isinstance(happened, DrawFinished)
                yield happened
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)

    def fail(self, error: Exception) -> None:
        """End `events` with ``error``."""
        self._happened.put_nowait(error)

    def _go_on(self, draws: Sequence[_Walk]) -> None:
        """Let vLLM write on for draws that have written the same."""
        task = asyncio.create_task(self._follow(draws))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _follow(self, draws: Sequence[_Walk]) -> None:
        try:
            written = [token.id for token in draws[0].tokens]
            number, self._requests = self._requests, self._requests + 1
            allowed, left = draws[0].cursor.allowed(), self._left(draws[0])
            # What is weighed, or likeliest, is the same for all draws, so vLLM is asked for one.
            weighs = self._expected(allowed) is not None
            shared = weighs or self._request.controls.temperature == 0
            asked = draws[:1] if shared else draws
            alone = weighs or self._between_numbers(allowed) or len(left) < len(allowed.ids)
            stream = self._llm.generate(
                self._prompt.then(written),
                self._parameters(asked, allowed, left, weighs=weighs, alone=alone),
                f"{self._request.request_id}/{number}",
            )
            following = {draw.index for draw in draws}
            async with aclosing(stream):
                async for output in stream:
                    for part in output.outputs:
                        for draw in draws if shared else draws[part.index : part.index + 1]:
                            tokens = part.token_ids[:1] if alone else part.token_ids
                            if draw.index in following and not self._walk(draw, tokens, part.logprobs, alone):
                                following.discard(draw.index)
                    if not following:
                        break
            if following:
                raise EngineError("vLLM ended a response before its format does")
            for group in _alike(draw for draw in draws if not draw.cursor.done):
                self._go_on(group)
        except EngineError as error:
            self.fail(error)
        except Exception as error:  # vLLM's own, of whatever type
            self.fail(EngineError.because("vLLM failed", error))

    def _parameters(
        self, draws: Sequence[_Walk], allowed: Allowed, left: IntArray, *, weighs: bool, alone: bool
    ) -> Any:
        from vllm import SamplingParams
        from vllm.sampling_params import RequestOutputKind, StructuredOutputsParams

        controls, first = self._request.controls, draws[0]
        named = self._branch_ids(first)
        if weighs or controls.logprobs:
            named = allowed.ids.tolist() if alone and len(allowed.ids) <= _MOST_NAMED else None
        grammar = None if alone else StructuredOutputsParams(grammar=self._grammar(first.cursor))
        return SamplingParams(
            n=len(draws),
            temperature=controls.temperature,
            top_p=controls.top_p,
            seed=seed_of(controls.seed, first.index, len(first.tokens)),
            max_tokens=1 if alone else first.cursor.compiled.longest(),
            logprobs=-1 if (weighs or controls.logprobs) and named is None else None,
            logprob_token_ids=named,
            allowed_token_ids=left.tolist() if alone else None,
            structured_outputs=grammar,
            detokenize=False,
            output_kind=RequestOutputKind.DELTA,
        )

    def _left(self, draw: _Walk) -> IntArray:
        """The allowed ids that name only what may be named."""
        ids = draw.cursor.allowed().ids
        left = None if self._reason_mask is None else self._reason_mask.leaves(draw.cursor, draw.tokens)
        return ids if left is None else ids[left]

    def _between_numbers(self, allowed: Allowed) -> bool:
        """Whether vLLM is asked for the next token alone: between numbers no grammar is needed."""
        return self._request.controls.numbers == "least_error" and len(allowed.ids) <= _MOST_NAMED

    def _expected(self, allowed: Allowed) -> Expected | None:
        """The expected error of each allowed id, to be weighed by it; None where vLLM's own choice stands."""
        return self._least_error.expected(allowed, self._request.controls)

    def _branch_ids(self, draw: _Walk) -> list[int] | None:
        """The tokens whose probabilities decide the branch, where it is still to come."""
        branch = self._family.branch
        if draw.think_probability is not None or branch is None:
            return None
        return [draw.cursor.compiled.literal(word)[0] for word in (branch.direct, branch.reflecting)]

    def _walk(
        self,
        draw: _Walk,
        tokens: Sequence[int],
        logprobs: Sequence[Mapping[int, Any]] | None,
        alone: bool,
    ) -> bool:
        """Write what vLLM wrote; False when the draw is done, or goes on with another request."""
        for place, token in enumerate(tokens):
            allowed, wanted = draw.cursor.allowed(), token
            expected = self._expected(allowed)
            weighed = None if logprobs is None else logprobs[place]
            if expected is not None and not _told(weighed, allowed.ids):
                break
            draw.passes += 1
            branch = self._family.branch
            if branch is not None and allowed.choice == branch.name and len(allowed.ids) > 1:
                assert weighed is not None
                wanted = self._decide(branch, draw, token, weighed)
            logprob = None
            if expected is not None or self._request.controls.logprobs:
                assert weighed is not None
                # vLLM tells them before temperature and grammar: logits up to a constant.
                logits = np.array([weighed[int(id)].logprob for id in allowed.ids])
                if expected is not None:
                    wanted = int(allowed.ids[least_error(logits, expected)])
                logprob = reported(self._request.controls, draw.cursor, logits, wanted)
            fits = wanted in self._left(draw)
            if fits:
                self._tell(draw, draw.append(wanted, self._parts.vocabulary, logprob))
            if not alone and fits and wanted == token and not draw.cursor.ending:
                continue
            self._tell(draw, draw.append_forced(self._parts.vocabulary))
            if draw.cursor.done:
                self._finish(draw)
                return False
            break
        else:
            return True
        return False

    def _decide(self, branch: Branch, draw: _Walk, token: int, logprobs: Mapping[int, Any]) -> int:
        """At the branch: the token that the controls decide for, vLLM's own where they leave it open."""
        options = {
            leads_to_reflection(branch, draw.cursor, int(id)): int(id) for id in draw.cursor.allowed().ids
        }
        direct, reflecting = (logprobs[options[reflects]].logprob for reflects in (False, True))
        draw.think_probability = 1 / (1 + math.exp(min(direct - reflecting, _FAR)))
        wanted = self._request.controls.second_look(draw.think_probability)
        return token if wanted is None else options[wanted]

    def _finish(self, draw: _Walk) -> None:
        for finished in read(
            self._request,
            self._family,
            draw,
            draw.passes,
            [draw.index],
            self._parts.vocabulary,
            self._parts.codec,
            self._reason_mask,
        ):
            self._happened.put_nowait(DrawFinished(finished))

    def _tell(self, draw: _Walk, finished: Sequence[SectionText]) -> None:
        vocabulary = self._parts.vocabulary
        for event in events_of(self._request, self._family, draw, finished, (draw.index,), vocabulary):
            self._happened.put_nowait(event)


def _alike(draws: Iterable[_Walk]) -> Iterable[list[_Walk]]:
    """Draws by what they have written: vLLM writes on for those that have written the same together."""
    groups: dict[tuple[int, ...], list[_Walk]] = {}
    for draw in draws:
        groups.setdefault(tuple(token.id for token in draw.tokens), []).append(draw)
    return groups.values()


def _told(weighed: Mapping[int, Any] | None, ids: IntArray) -> bool:
    """Whether vLLM was asked for the probabilities of all ``ids``."""
    return weighed is not None and all(int(id) in weighed for id in ids)
