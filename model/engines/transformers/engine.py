"""The engine interface over `transformers` alone."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import torch

from looktwice.model.engines.engine import (
    DrawFinished,
    EngineError,
    EngineLoad,
    Event,
    PlanRequest,
    RequestError,
    Started,
)
from looktwice.model.engines.engine_requests import PictureCodes, events_of, read, start_cursor
from looktwice.model.engines.gate import Gate
from looktwice.model.engines.picture_threads import PictureThreads
from looktwice.model.engines.transformers.foreign_network import ForeignNetwork
from looktwice.model.engines.transformers.own_network import OwnNetwork
from looktwice.model.engines.transformers.plain_decoder import PlainDecoder, Prepared
from looktwice.model.engines.transformers.plain_network import Network
from looktwice.model.engines.warm_up import warm_up
from looktwice.model.formats.cursor import Cursor
from looktwice.model.network.card import CheckpointError, is_foreign
from looktwice.model.network.checkpoint import load
from looktwice.model.network.foreign_checkpoint import load_foreign
from looktwice.model.network.model_card import ModelCard
from looktwice.model.network.visual_codes import Frame

_Tell = Callable[[Event | Exception], bool]
"""Hands an event on; False where nobody waits for more."""


class TransformersEngine:
    """`looktwice.model.engines.engine.Engine` over a checkpoint folder; see there for the contract.

    One thread writes one draw after the other, a token a pass. Deadlines are refused: nothing is made ready
    beside a second look that could take its place.

    Args:
        checkpoint: its folder.
        rows: draws that may be asked for at once; more are refused by the service.
        dtype: of the network.
        formats: that a foreign checkpoint is to write, the default first. LookTwice's own name theirs.

    Raises:
        CheckpointError: the folder is no usable checkpoint, or cannot write a format.
        FamilyError: there is no such format.
    """

    def __init__(
        self,
        checkpoint: Path,
        rows: int = 24,
        dtype: torch.dtype = torch.float32,
        formats: Sequence[str] = (),
    ) -> None:
        self._network, self._rows = _network(checkpoint, dtype, formats), rows
        self._decoding = PlainDecoder(self._network)
        self._pictures, self._gate = PictureThreads(), Gate()
        self._thread: ThreadPoolExecutor | None = None
        self._ended: asyncio.Event | None = None
        self._running: dict[str, tuple[PlanRequest, asyncio.Queue[Event | Exception]]] = {}

    @property
    def card(self) -> ModelCard:
        """What is loaded."""
        return self._network.card

    @property
    def load(self) -> EngineLoad:
        """How full it is now; what waits for the thread counts as far as there would be room."""
        asked = sum(request.controls.n for request, _ in self._running.values())
        return EngineLoad(self._rows, min(asked, self._rows), self._pictures.waiting_s)

    async def start(self) -> None:
        """Start the thread and plan once for a grey scene in every format."""
        if self._thread is not None:
            raise EngineError("the engine runs already")
        self._thread = ThreadPoolExecutor(1, "looktwice-transformers")
        self._ended = asyncio.Event()
        await warm_up(self)

    async def wait(self) -> None:
        """Wait until the engine was stopped. A draw that fails ends its request alone."""
        if self._ended is not None:
            await self._ended.wait()

    async def stop(self) -> None:
        """Cancel everything and end the thread; running requests get an `EngineError`."""
        if self._thread is None or self._ended is None:
            return
        for name in list(self._running):
            self._end(name, EngineError("the engine was stopped"))
        self._pictures.close()
        thread, self._thread = self._thread, None
        await asyncio.to_thread(thread.shutdown)
        self._ended.set()

    async def load_weights(self, checkpoint: Path) -> None:
        """Take new weights between two draws; see `Engine.load_weights`. For a moment both are in memory."""
        async with self._gate.change():
            if self._thread is None:
                raise EngineError("the engine is not running")
            await asyncio.wrap_future(self._thread.submit(self._network.load_weights, checkpoint))

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        """Queue a request and iterate over its events; see `Engine.submit`."""
        if (thread := self._thread) is None:
            raise EngineError("the engine is not running")
        if request.request_id in self._running:
            raise RequestError(f"request id {request.request_id} is in use")
        start = self._start(request)
        self._network.check(request)
        if request.controls.deadline_ms is not None:
            raise RequestError("deadline_ms needs the torch engine: this one makes no drafts")
        events: asyncio.Queue[Event | Exception] = asyncio.Queue()
        running = self._running[request.request_id] = request, events
        writing: Future[None] | None = None
        try:
            async with self._gate.request():
                inputs, expected = await self._pictures.run(
                    partial(self._network.inputs, request), request.scene.pictures
                )
                if expected is not None:
                    start = self._start(request, expected)
                loop = asyncio.get_running_loop()

                def tell(event: Event | Exception) -> bool:
                    loop.call_soon_threadsafe(events.put_nowait, event)
                    return self._running.get(request.request_id) is running

                # Who was cancelled meanwhile has been told so.
                if self._running.get(request.request_id) is running:
                    writing = thread.submit(self._write, request, start, inputs, tell)
                remaining = request.controls.n
                while remaining:
                    event = await events.get()
                    if isinstance(event, Exception):
                        raise event
                    remaining -= isinstance(event, DrawFinished)
                    yield event
        finally:
            if self._running.get(request.request_id) is running:
                del self._running[request.request_id]
            if writing is not None:
                writing.cancel()

    def prompt_tokens(self, request: PlanRequest) -> int:
        """See `Engine.prompt_tokens`."""
        return self._network.prompt_tokens(request)

    def paint(self, request: PlanRequest, codes: Sequence[int]) -> Frame:
        """An imagined picture; see `Engine.paint`."""
        return self._network.paint(request, codes)

    def cancel(self, request_id: str) -> None:
        """Drop a request; unknown ids are ignored."""
        if request_id in self._running:
            self._end(request_id, EngineError("the request was cancelled"))

    def _end(self, request_id: str, error: EngineError) -> None:
        _, events = self._running.pop(request_id)
        events.put_nowait(error)

    def _start(self, request: PlanRequest, expected: PictureCodes = None) -> Cursor:
        network = self._network
        return start_cursor(request, network.card, network.families, network.formats, expected)

    def _write(self, request: PlanRequest, start: Cursor, inputs: Any, tell: _Tell) -> None:
        """Write all draws, in the thread; ends where nobody waits for them any more."""
        tell(Started())
        try:
            with torch.inference_mode():
                asked = self._decoding.begin(request, self._network.families[request.format], start, inputs)
                for index in range(request.controls.n):
                    if not all(map(tell, self._draw(asked, index))):
                        return
        except Exception as error:  # one request that cannot be decoded must not end the others
            tell(EngineError.because("decoding failed", error))

    def _draw(self, asked: Prepared, index: int) -> Iterator[Event]:
        request, family, vocabulary = asked.request, asked.family, self._network.vocabulary
        for step in self._decoding.write(asked, index):
            yield from events_of(request, family, step.response, step.finished, (index,), vocabulary)
        parts = vocabulary, self._network.codec, asked.reason_mask
        yield DrawFinished(*read(request, family, step.response, step.run.passes, (index,), *parts))


def _network(checkpoint: Path, dtype: torch.dtype, formats: Sequence[str]) -> Network:
    if is_foreign(checkpoint):
        return ForeignNetwork(load_foreign(checkpoint, formats, dtype))
    own = OwnNetwork(load(checkpoint, dtype))
    if formats:
        written = ", ".join(own.card.formats)
        raise CheckpointError(
            f"{checkpoint} is a checkpoint of LookTwice, which writes {written}; leave out --format"
        )
    return own
