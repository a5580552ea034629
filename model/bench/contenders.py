"""What is measured: ways to answer plan requests, each at its best settings."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from looktwice.model.engines.engine import Draw, DrawFinished, Engine, PlanRequest
from looktwice.model.families.registry import families_of
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.pieces import FormatError
from looktwice.model.formats.text import parse
from looktwice.model.network.vocabulary import END_OF_TEXT, IM_END, Vocabulary

SHORTCUTS = ("jump", "shared_prompts", "shared_rows", "speculate", "reuse", "capture")
"""The torch engine's, in the order in which the bench switches them on."""


@dataclass(frozen=True)
class CountedResponse:
    """One draw as the bench counts it: tokens, those chosen, network passes, and whether it parses."""

    tokens: int
    chosen: int
    passes: int
    valid: bool


@dataclass(frozen=True)
class TimedAnswer:
    """One request: seconds from submission to its last draw, and its draws."""

    latency_s: float
    responses: tuple[CountedResponse, ...]


class Contender(ABC):
    """Something that answers requests; by default nothing has to be started, and nothing is known."""

    async def start(self) -> None:
        """Load and warm up."""
        return

    @abstractmethod
    async def answer(self, requests: Sequence[PlanRequest]) -> list[TimedAnswer]:
        """Answer requests that arrive at once."""

    def counts(self) -> dict[str, int]:
        """What decoding took so far, where that is known."""
        return {}

    async def stop(self) -> None:
        """Free everything."""
        return


async def _each(
    requests: Sequence[PlanRequest], respond: Callable[[PlanRequest], Awaitable[list[CountedResponse]]]
) -> list[TimedAnswer]:
    async def timed(request: PlanRequest) -> TimedAnswer:
        began_s = time.perf_counter()
        responses = await respond(request)
        return TimedAnswer(time.perf_counter() - began_s, tuple(responses))

    return list(await asyncio.gather(*map(timed, requests)))


class EngineContender(Contender):
    """An engine behind our interface."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    async def start(self) -> None:
        """Load and warm up."""
        await self._engine.start()

    async def answer(self, requests: Sequence[PlanRequest]) -> list[TimedAnswer]:
        """Answer requests that arrive at once."""

        async def respond(request: PlanRequest) -> list[CountedResponse]:
            events = [event async for event in self._engine.submit(request)]
            return [_counted(event.draw) for event in events if isinstance(event, DrawFinished)]

        return await _each(requests, respond)

    def counts(self) -> dict[str, int]:
        """What decoding took so far."""
        counts = getattr(self._engine, "counts", None)
        return {} if counts is None else asdict(counts)

    async def stop(self) -> None:
        """Free everything."""
        await self._engine.stop()


def _counted(draw: Draw) -> CountedResponse:
    return CountedResponse(sum(draw.tokens.values()), draw.chosen, draw.passes, valid=True)


class PlainVllm(Contender):
    """vLLM without a grammar: whatever the model writes, up to its end-of-message token.

    The engine is started and stopped by whoever made it.
    """

    def __init__(self, checkpoint: Path, engine: Any, max_tokens: int) -> None:
        from looktwice.model.network.checkpoint import read_parts

        self._engine, self._max_tokens = engine, max_tokens
        parts = read_parts(checkpoint)
        self._vocabulary = parts.vocabulary
        families = families_of(parts.card.formats, parts.settings.reflection)
        self._formats = {
            name: CompiledFormat(each.format, self._vocabulary) for name, each in families.items()
        }

    async def answer(self, requests: Sequence[PlanRequest]) -> list[TimedAnswer]:
        """Answer requests that arrive at once."""
        from vllm import SamplingParams
        from vllm.sampling_params import RequestOutputKind

        async def respond(request: PlanRequest) -> list[CountedResponse]:
            controls = request.controls
            parameters = SamplingParams(
                n=controls.n,
                temperature=controls.temperature,
                seed=controls.seed,
                max_tokens=self._max_tokens,
                detokenize=False,
                output_kind=RequestOutputKind.FINAL_ONLY,
            )
            prompt = await asyncio.to_thread(self._engine.prompt, request.scene, request.format)
            responses: list[CountedResponse] = []
            async for output in self._engine.llm.generate(prompt.then([]), parameters, request.request_id):
                format = self._formats[request.format]
                responses += [
                    _read(list(part.token_ids), format, self._vocabulary) for part in output.outputs
                ]
            return responses

        return await _each(requests, respond)


class Transformers(Contender):
    """`generate` over one batch of all requests' draws; pictures are encoded once a scene.

    Args:
        cache: ``dynamic``, or ``static``, with which `generate` compiles its steps where there is a GPU.
    """

    def __init__(self, checkpoint: Path, *, dtype: Any, device: str, max_tokens: int, cache: str) -> None:
        from looktwice.model.network.checkpoint import load

        self._loaded = load(checkpoint, dtype, device)
        families = families_of(self._loaded.card.formats, self._loaded.settings.reflection)
        self._formats = {
            name: CompiledFormat(each.format, self._loaded.vocabulary) for name, each in families.items()
        }
        self._max_tokens, self._cache = max_tokens, cache

    async def answer(self, requests: Sequence[PlanRequest]) -> list[TimedAnswer]:
        """Answer requests as one batch, on this thread: torch gets slower where a second one uses it."""
        import torch

        began_s = time.perf_counter()
        loaded, n, format = self._loaded, requests[0].controls.n, requests[0].format
        vocabulary = loaded.vocabulary
        model: Any = loaded.model
        with torch.inference_mode():
            prompts = [
                model.encode_prompt_embeddings(loaded.inputs.build(request.scene, format, request.attempt))
                for request in requests
            ]
            embeddings = torch.stack([prompt.embeddings for prompt in prompts]).repeat_interleave(n, 0)
            positions = torch.stack([prompt.position_ids for prompt in prompts], 1).repeat_interleave(n, 1)
            torch.manual_seed(requests[0].controls.seed)
            written = model.generate(
                inputs_embeds=embeddings,
                position_ids=positions,
                attention_mask=torch.ones(embeddings.shape[:2], dtype=torch.long, device=embeddings.device),
                do_sample=True,
                temperature=requests[0].controls.temperature,
                top_k=0,
                top_p=1.0,
                max_new_tokens=self._max_tokens,
                cache_implementation=self._cache,
                eos_token_id=vocabulary.id_of(IM_END),
                pad_token_id=vocabulary.id_of(END_OF_TEXT),
            )
        steps, padding = written.shape[1], vocabulary.id_of(END_OF_TEXT)
        responses = [
            _read([token for token in row if token != padding], self._formats[format], vocabulary, steps)
            for row in written.tolist()
        ]
        latency_s = time.perf_counter() - began_s
        return [
            TimedAnswer(latency_s, tuple(responses[first : first + n]))
            for first in range(0, len(responses), n)
        ]


def _read(
    ids: list[int], format: CompiledFormat, vocabulary: Vocabulary, steps: int | None = None
) -> CountedResponse:
    """A response written without a grammar; each token was chosen, and took a pass."""
    try:
        parse(format, vocabulary.decode(ids))
        valid = True
    except FormatError:
        valid = False
    return CountedResponse(len(ids), len(ids), steps or len(ids), valid)
