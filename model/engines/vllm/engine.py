"""The vLLM engine: `AsyncLLM` behind the same interface, for checkpoints and clusters that outgrow ours."""

from __future__ import annotations

import asyncio
import gc
import os
from collections.abc import AsyncGenerator, Mapping, Sequence
from contextlib import aclosing
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from looktwice.model.driving.scene import Scene
from looktwice.model.engines.engine import EngineError, EngineLoad, Event, PlanRequest, RequestError
from looktwice.model.engines.engine_requests import inputs_of, painted, prompt_tokens, start_cursor
from looktwice.model.engines.least_error import LeastError
from looktwice.model.engines.picture_threads import PictureThreads
from looktwice.model.engines.reason_mask import reason_mask_of
from looktwice.model.engines.vllm.decoding import Decoding, VllmPrompt
from looktwice.model.engines.vllm.items import PLACEHOLDERS, items_of, kinds_of
from looktwice.model.engines.warm_up import warm_up
from looktwice.model.families.family import Attempt, PictureRequest
from looktwice.model.families.registry import families_of
from looktwice.model.formats.cursor import Active, CompiledFormat, Cursor, Rest
from looktwice.model.formats.grammar_export import to_lark
from looktwice.model.network.card import CheckpointError
from looktwice.model.network.checkpoint import read_parts
from looktwice.model.network.model_card import ModelCard
from looktwice.model.network.visual_codes import Frame

_ENVIRONMENT: Final = {"VLLM_NO_USAGE_STATS": "1", "HF_HUB_OFFLINE": "1", "VLLM_CPU_KVCACHE_SPACE": "2"}
"""Unless set otherwise: nothing is sent or fetched; 2 GiB of keys and values where there is no GPU."""
_LOOK_AGAIN_S: Final = 0.5
"""vLLM tells nobody that its processes have died; whoever asks is told."""
_GRAMMARS: Final = 256
"""Kept, some 40 kB each: those of formats and branches, and of the latest places where draws went on."""


@dataclass(frozen=True)
class VllmSettings:
    """How the vLLM engine runs.

    Attributes:
        rows: draws decoded at once; more wait.
        dtype: of weights, keys and values, as vLLM names it.
        arguments: anything else that vLLM's ``AsyncEngineArgs`` take, such as ``tensor_parallel_size``,
            ``data_parallel_size``, ``distributed_executor_backend``, ``gpu_memory_utilization``.
    """

    rows: int = 96
    dtype: str = "auto"
    arguments: Mapping[str, Any] = field(default_factory=dict)


class VllmEngine:
    """`looktwice.model.engines.engine.Engine` over a checkpoint folder; see there for the contract.

    vLLM writes tokens under a grammar, and a cursor walks along with every draw. Where the two part (a
    control decides the branch otherwise, or the grammar allows what the format forbids), the draw goes on
    from what the cursor allows in a request of its own, whose beginning lies in vLLM's prefix cache.

    Deadlines are refused: vLLM cannot cut a text short and go on. Random numbers are vLLM's, so a seed
    gives other draws than with the torch engine; at temperature 0 both write the same.
    """

    def __init__(self, checkpoint: Path, settings: VllmSettings = VllmSettings()) -> None:
        self._checkpoint, self._settings = checkpoint, settings
        self._parts = read_parts(checkpoint)
        self._card = replace(self._parts.card, engine="vllm", deadlines=False)
        self._families = families_of(self._card.formats, self._parts.settings.reflection)
        self._formats = {
            name: CompiledFormat(family.format, self._parts.vocabulary)
            for name, family in self._families.items()
        }
        self._least_error = LeastError(self._parts.codec, self._parts.vocabulary)
        self._llm: Any = None
        self._running: dict[str, Decoding] = {}
        self._pictures = PictureThreads()

        @lru_cache(_GRAMMARS)
        def grammar(compiled: CompiledFormat, active: Active, rest: Rest) -> str:
            return to_lark(Cursor(compiled, active, "", rest))

        self._grammar = grammar

    @property
    def card(self) -> ModelCard:
        """What is loaded."""
        return self._card

    @property
    def load(self) -> EngineLoad:
        """How full it is now; what waits within vLLM counts as far as there would be room."""
        asked = sum(decoding.draws for decoding in self._running.values())
        return EngineLoad(self._settings.rows, min(asked, self._settings.rows), self._pictures.waiting_s)

    @property
    def llm(self) -> Any:
        """vLLM's own ``AsyncLLM``; raises `EngineError` while the engine does not run."""
        if self._llm is None:
            raise EngineError("the engine is not running")
        return self._llm

    async def start(self) -> None:
        """Start vLLM's processes and plan once for a grey scene in every format."""
        if self._llm is not None:
            raise EngineError("the engine runs already")
        for name, value in _ENVIRONMENT.items():
            os.environ.setdefault(name, value)
        try:
            await asyncio.to_thread(self._load)
        except Exception as error:  # vLLM's own, of whatever type
            raise EngineError.because("vLLM did not start", error) from error
        await warm_up(self)

    async def wait(self) -> None:
        """Wait until vLLM does not run any more; raises `EngineError` when it died."""
        while self._llm is not None:
            if self._llm.errored:
                raise EngineError.because("vLLM died", self._llm.dead_error)
            await asyncio.sleep(_LOOK_AGAIN_S)

    async def stop(self) -> None:
        """Cancel everything and end vLLM's processes; running requests get an `EngineError`."""
        if self._llm is None:
            return
        for decoding in self._running.values():
            decoding.fail(EngineError("the engine was stopped"))
        self._pictures.close()
        llm, self._llm = self._llm, None
        # Else it would take the end of vLLM's processes for their death, and say so.
        if llm.output_handler is not None:
            llm.output_handler.cancel()
        await asyncio.to_thread(llm.shutdown)
        # vLLM shuts down once more when it is collected, which fails where the interpreter ends first.
        del llm
        gc.collect()

    async def load_weights(self, checkpoint: Path) -> None:
        """Refused; see `Engine.load_weights`."""
        # On a CPU `reload_weights` of vLLM 0.32 warns that it has not loaded a tied head, and texts differ.
        raise CheckpointError(
            f"vLLM takes no new weights exactly, so not those of {checkpoint}: start an engine over it"
        )

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        """Queue a request and iterate over its events; see `Engine.submit`."""
        llm = self.llm
        if request.request_id in self._running:
            raise RequestError(f"request id {request.request_id} is in use")
        start = start_cursor(request, self._card, self._families, self._formats)
        if request.controls.deadline_ms is not None:
            raise RequestError("deadline_ms needs the torch engine: vLLM cannot cut a text short and go on")
        if request.controls.imagine_once:
            raise RequestError("imagine_once needs the torch engine: vLLM gives each draw its random numbers")
        if request.controls.bind:
            raise RequestError("bind needs the torch engine: vLLM has no grammar that depends on the plan")
        family = self._families[request.format]
        # Facts that are read from pictures stay within vLLM's processes: only tracks tell what is in view.
        reason_mask = reason_mask_of(request, family, self._parts.vocabulary, None)
        decoding = Decoding(
            llm, self._parts, self._grammar_of, request, family, self._least_error, reason_mask
        )
        self._running[request.request_id] = decoding
        try:
            scene, format, attempt = request.scene, request.format, request.attempt
            view = request.controls.view
            prompt, expected = await self._pictures.run(
                lambda: (
                    self.prompt(scene, format, attempt, view),
                    self._parts.inputs.expected(scene, view),
                ),
                scene.pictures,
            )
            if expected is not None:
                start = start_cursor(request, self._card, self._families, self._formats, expected)
            async with aclosing(decoding.events(prompt, start)) as events:
                async for event in events:
                    yield event
        finally:
            del self._running[request.request_id]

    def prompt_tokens(self, request: PlanRequest) -> int:
        """See `Engine.prompt_tokens`."""
        return prompt_tokens(self._parts.inputs, request)

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> Frame:
        """An imagined picture; see `Engine.paint`."""
        return painted(self._parts.visual_codes, request, codes)

    def cancel(self, request_id: str) -> None:
        """Drop a request; unknown ids are ignored."""
        if decoding := self._running.get(request_id):
            decoding.fail(EngineError("the request was cancelled"))

    def prompt(
        self, scene: Scene, format: str, attempt: Attempt | None = None, view: PictureRequest | None = None
    ) -> VllmPrompt:
        """A scene as vLLM takes it, with the attempt that is to be refined, and the picture to be seen.

        Raises:
            RequestError: the scene cannot be made into inputs (a missing camera).
            ImageError: a picture is damaged.
        """
        inputs = inputs_of(self._parts.inputs, scene, format, attempt, view)
        ids, items = inputs.prompt.ids, items_of(inputs, self._parts.settings)
        # vLLM wants one placeholder an item and repeats it by itself.
        repeated = np.isin(ids, [self._parts.vocabulary.id_of(PLACEHOLDERS[kind]) for kind in items])
        kept = ~repeated | (np.roll(ids, 1) != ids)
        return VllmPrompt(ids[kept].tolist(), items)

    def _grammar_of(self, cursor: Cursor) -> str:
        assert cursor.active is not None
        return self._grammar(cursor.compiled, cursor.active, cursor.rest)

    def _load(self) -> None:
        from vllm.engine.arg_utils import AsyncEngineArgs
        from vllm.platforms import current_platform
        from vllm.v1.engine.async_llm import AsyncLLM

        settings = self._parts.settings
        prompts = [self._parts.inputs.longest_prompt(format) for format in self._card.formats]
        limits = {name: kind.items for name, kind in kinds_of(settings).items()}
        arguments = {
            "model": str(self._checkpoint),
            "dtype": self._settings.dtype,
            "max_num_seqs": self._settings.rows,
            "max_model_len": max(prompts) + max(each.longest() for each in self._formats.values()),
            "limit_mm_per_prompt": limits,
            "structured_outputs_config": {"backend": "guidance"},
            "disable_log_stats": True,
            # Codes of least expected error need the probabilities of a whole stage.
            "max_logprobs": -1,
        }
        if current_platform.is_cpu():
            # Blocks of 128 tokens would leave most of a prompt out of the prefix cache; where prompts come in
            # chunks, a seed ends vLLM ("CPU Generator does not use offset", 0.32).
            arguments |= {"block_size": 32, "enable_chunked_prefill": False, "max_num_batched_tokens": 8192}
        self._llm = AsyncLLM.from_engine_args(AsyncEngineArgs(**(arguments | dict(self._settings.arguments))))
