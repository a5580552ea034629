"""The torch engine: the decoding loop on a thread of its own, behind the asynchronous interface."""

from __future__ import annotations

import asyncio
import queue
import time
from collections.abc import AsyncGenerator, Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import torch

from looktwice.model.engines.binding import Binding, binding_of
from looktwice.model.engines.engine import (
    DrawFinished,
    EngineError,
    EngineLoad,
    Event,
    PlanRequest,
    RequestError,
)
from looktwice.model.engines.engine_requests import painted, prompt_tokens
from looktwice.model.engines.gate import Gate
from looktwice.model.engines.picture_threads import PictureThreads
from looktwice.model.engines.torch.decoder import Counts, Decoder, Failed
from looktwice.model.engines.torch.graphs import CudaGraph
from looktwice.model.engines.torch.picture_cache import Frames
from looktwice.model.engines.torch.runner import Runner
from looktwice.model.engines.torch.shortcuts import Shortcuts
from looktwice.model.engines.torch.threads import FreeCores, fit_threads
from looktwice.model.engines.torch.worker import Worker
from looktwice.model.engines.warm_up import warm_up
from looktwice.model.network.allocator import FreedMemory
from looktwice.model.network.card import CheckpointError
from looktwice.model.network.checkpoint import load
from looktwice.model.network.model_card import ModelCard
from looktwice.model.network.precision import bfloat16_is_fast
from looktwice.model.network.visual_codes import Frame
from looktwice.model.network.weights import load_weights

_DRAWS_A_SCENE: Final = 6
"""That most requests ask for."""
_THREAD: Final = "looktwice-engine"
_WARM_TOKENS: Final = 1024
"""Passes with more tokens are rare, and large enough not to notice how their kernels are made."""


@dataclass(frozen=True)
class TorchSettings:
    """How the torch engine runs.

    Attributes:
        rows: draws decoded at once; more wait.
        prompts: scenes decoded at once, each with memory for what its draws usually write; by default a
            sixth of the rows, as most requests ask for six draws. On a CPU memory is taken from the system
            as it is used.
        clip_bytes: of vision tokens kept for pictures that come again, and as many of keys and values.
        dtype: of weights, keys and values.
        products: what matrix products are worked out in; by default bfloat16 on CPUs that have units for
            it (AMX, AVX-512 BF16) and the weights' own type elsewhere.
        device: ``cpu`` or ``cuda``.
        reproducible: the same request gets the same answer to the last bit, whatever else runs and whatever
            pictures were seen before; on a CPU, where that is cheap.
        shortcuts: what makes decoding fast and changes no response.
    """

    rows: int = 96
    prompts: int | None = None
    clip_bytes: int = 256 << 20
    dtype: torch.dtype = torch.float32
    products: torch.dtype | None = field(
        default_factory=lambda: torch.bfloat16 if bfloat16_is_fast() else None
    )
    device: str = "cpu"
    reproducible: bool = True
    shortcuts: Shortcuts = field(default_factory=Shortcuts)

    @classmethod
    def on(cls, device: str, rows: int) -> TorchSettings:
        """What a device does best: on a GPU everything is in bfloat16."""
        if device == "cpu":
            return cls(rows=rows)
        return cls(rows=rows, dtype=torch.bfloat16, products=None, device=device, reproducible=False)


def _worker() -> Worker:
    worker = Worker(_THREAD)
    worker.submit(fit_threads)
    return worker


class _Listener:
    """Who waits for the events of a request, which another thread tells.

    Attributes:
        events: that were told, for the loop that this was made in.
        left: whether nobody waits any more.
    """

    def __init__(self) -> None:
        self.events: asyncio.Queue[Event | Failed] = asyncio.Queue()
        self.left = False
        self._loop = asyncio.get_running_loop()

    def tell(self, event: Event | Failed) -> None:
        """Pass an event on, from any thread."""
        if not self.left:
            self._loop.call_soon_threadsafe(self.events.put_nowait, event)


class TorchEngine:
    """`looktwice.model.engines.engine.Engine` over a checkpoint folder; see there for the contract."""

    def __init__(self, checkpoint: Path, settings: TorchSettings = TorchSettings()) -> None:
        self._settings = settings
        self._worker: Worker | None = _worker()
        loading = self._worker.submit(lambda: load(checkpoint, settings.dtype, settings.device))
        try:
            self._loaded = loading.result()
        except BaseException:
            self._worker.close()
            raise
        self._card = self._loaded.card
        self._frames, self._pictures, self._gate = Frames(self._loaded.inputs), PictureThreads(), Gate()
        self._decoding: Future[None] | None = None
        self._counts, self._rows_used = Counts(), 0
        self._broke: EngineError | None = None
        self._commands: queue.SimpleQueue[Callable[[Decoder], None] | None] = queue.SimpleQueue()
        self._listeners: dict[str, _Listener] = {}
        # The decoding thread's own. Who left early may ask again under the same name during the step that
        # decodes the first request: its events must not become answers of the second.
        self._decoded_for: dict[str, _Listener] = {}

    @property
    def card(self) -> ModelCard:
        """What is loaded."""
        return self._card

    @property
    def load(self) -> EngineLoad:
        """How full it is now."""
        return EngineLoad(self._settings.rows, self._rows_used, self._pictures.waiting_s)

    @property
    def counts(self) -> Counts:
        """What decoding took so far."""
        return self._counts

    async def start(self) -> None:
        """Start the decoding thread and plan once for a grey scene in every format."""
        if self._decoding is not None:
            raise EngineError("the engine runs already")
        self._worker = self._worker or _worker()
        self._broke = None
        # What was asked of a thread that broke is answered already.
        self._commands, self._decoded_for = queue.SimpleQueue(), {}
        self._decoding = self._worker.submit(self._run)
        await warm_up(self)

    async def wait(self) -> None:
        """Wait until the thread has ended; raises `EngineError` when decoding failed."""
        if self._decoding is not None:
            # Shielded: who stops waiting must not cancel what the thread is about to answer.
            await asyncio.shield(asyncio.wrap_future(self._decoding))
        if self._broke is not None:
            raise self._broke

    async def stop(self) -> None:
        """Cancel everything and end the thread; running requests get an `EngineError`."""
        if self._decoding is not None:
            self._commands.put(None)
            await asyncio.wrap_future(self._decoding)
        worker, self._worker, self._decoding = self._worker, None, None
        self._pictures.close()
        if worker is not None:
            await asyncio.to_thread(worker.close)

    async def load_weights(self, checkpoint: Path) -> None:
        """Take new weights between steps; see `Engine.load_weights`. For a moment both are in memory."""
        async with self._gate.change():
            if self._decoding is None or self._decoding.done():
                raise EngineError("the engine is not running")
            taken: Future[None] = Future()
            self._commands.put(lambda decoder: self._take(decoder, checkpoint, taken))
            # A thread that was told to end before it comes to this never answers.
            answer, end = asyncio.wrap_future(taken), asyncio.wrap_future(self._decoding)
            await asyncio.wait([answer, end], return_when=asyncio.FIRST_COMPLETED)
            if not answer.done():
                raise EngineError("the engine was stopped")
            answer.result()

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        """Queue a request and iterate over its events; see `Engine.submit`."""
        if self._decoding is None or self._decoding.done():
            raise EngineError("the engine is not running")
        if request.request_id in self._listeners:
            raise RequestError(f"request id {request.request_id} is in use")
        listener = self._listeners[request.request_id] = _Listener()
        # Now and not when the thread gets to it, which may be a long step later.
        submitted_s = time.monotonic()
        try:
            async with self._gate.request():
                if listener.events.empty():  # else it was cancelled before the gate
                    binding = await self._pictures.run(
                        lambda: self._prepared(request), request.scene.pictures
                    )
                    self._commands.put(
                        lambda decoder: self._add(decoder, request, submitted_s, binding, listener)
                    )
                remaining = request.controls.n
                while remaining:
                    event = await listener.events.get()
                    if isinstance(event, Failed):
                        raise event.error
                    remaining -= isinstance(event, DrawFinished)
                    yield event
        finally:
            if self._listeners.pop(request.request_id, None):
                listener.left = True
                self.cancel(request.request_id)

    def prompt_tokens(self, request: PlanRequest) -> int:
        """See `Engine.prompt_tokens`."""
        return prompt_tokens(self._loaded.inputs, request)

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> Frame:
        """An imagined picture; see `Engine.paint`."""
        return painted(self._loaded.visual_codes, request, codes)

    def cancel(self, request_id: str) -> None:
        """Drop a request; unknown ids are ignored."""
        if listener := self._listeners.get(request_id):
            listener.tell(Failed(EngineError("the request was cancelled")))
        self._commands.put(lambda decoder: self._drop(decoder, request_id))

    def _prepared(self, request: PlanRequest) -> Binding | None:
        """Do what would hold up the decoding thread."""
        self._frames.look_at(request.scene)
        # Kept there for the decoder, which asks again.
        self._loaded.inputs.expected(request.scene, request.controls.view)
        return binding_of(request, self._loaded.codec, self._loaded.vocabulary)

    def _take(self, decoder: Decoder, checkpoint: Path, taken: Future[None]) -> None:
        """Go on with the weights of a folder, in the decoding thread; ``taken`` says how that went."""
        try:
            # The network's own tensors are none of inference mode.
            with torch.inference_mode(False):
                card = load_weights(self._loaded, checkpoint)
            decoder.renew()
        except CheckpointError as error:
            taken.set_exception(error)
        except Exception as error:  # with half of the weights it must not go on
            taken.set_exception(EngineError.because("the weights could not be taken", error))
            raise
        else:
            self._card = card
            taken.set_result(None)

    def _add(
        self,
        decoder: Decoder,
        request: PlanRequest,
        submitted_s: float,
        binding: Binding | None,
        listener: _Listener,
    ) -> None:
        try:
            decoder.add(request, submitted_s, binding)
        except RequestError as error:
            listener.tell(Failed(error))
        except Exception as error:  # one request that cannot be read must not end the others
            listener.tell(Failed(EngineError.because("the request could not be begun", error)))
        else:
            self._decoded_for[request.request_id] = listener

    def _drop(self, decoder: Decoder, request_id: str) -> None:
        decoder.cancel(request_id)
        self._decoded_for.pop(request_id, None)

    def _run(self) -> None:
        settings = self._settings
        reason: Exception = EngineError("the engine was stopped")
        try:
            with torch.inference_mode():
                runner = Runner(
                    self._loaded,
                    settings.rows,
                    prompts=settings.prompts or self._prompts(),
                    clip_bytes=settings.clip_bytes,
                    frames=self._frames,
                    products=settings.products,
                    reproducible=settings.reproducible,
                    reuse=settings.shortcuts.reuse,
                    capture=CudaGraph if settings.shortcuts.capture and settings.device == "cuda" else None,
                )
                decoder = Decoder(runner, settings.shortcuts, clock=time.monotonic)
                self._counts = decoder.counts
                runner.warm_up(_WARM_TOKENS)
                cores, freed = FreeCores(torch.get_num_threads()), FreedMemory()
                while self._obey(decoder, cores):
                    if cores.threads != cores.look():
                        torch.set_num_threads(cores.threads)
                    freed.give_back()
                    events = decoder.step()
                    # Before anybody hears of an end: who asks then must not find its rows in use.
                    self._rows_used = decoder.rows_used
                    for request_id, event in events:
                        self._decoded_for[request_id].tell(event)
        except Exception as error:  # the thread's last word: everyone who waits must hear of it
            reason = self._broke = EngineError.because("decoding failed", error)
        self._rows_used = 0
        for listener in list(self._listeners.values()):
            listener.tell(Failed(reason))

    def _prompts(self) -> int:
        settings = self._settings
        return -(-settings.rows // _DRAWS_A_SCENE) if settings.shortcuts.shared_prompts else settings.rows

    def _obey(self, decoder: Decoder, cores: FreeCores) -> bool:
        """Carry out what was asked for; waits only while there is nothing to decode. False ends the loop."""
        while decoder.idle or not self._commands.empty():
            if waits := decoder.idle:
                cores.rest()
            command = self._commands.get()
            if waits:
                cores.resume()
            if command is None:
                return False
            command(decoder)
            self._rows_used = decoder.rows_used
        return True
