"""Answers as server-sent events, while draws are being written."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import aclosing
from typing import Final, TypeVar

import structlog
from fastapi.sse import format_sse_event
from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import StreamingResponse

import looktwice.clients.wire as wire
from looktwice.service.http.callers import CallerLeft, while_connected
from looktwice.service.http.problem_documents import problem_document
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.planning.events import PlannedScene, SceneEvent
from looktwice.service.problems import ProblemError, unforeseen

log = structlog.stdlib.get_logger()

_NO_BUFFERING: Final = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
"""Proxies must not hold events back."""

Data = TypeVar("Data", bound=BaseModel)
Tell = Callable[[SceneEvent], Awaitable[Sequence[tuple[str, Data]]]]
"""What an event of a scene is in the wire's words: events with their data, none where it is not told of."""


async def wire_events(
    first: SceneEvent, events: AsyncGenerator[SceneEvent], tell: Tell[Data], metrics: Metrics
) -> AsyncGenerator[tuple[str, Data] | PlannedScene]:
    """What happens to a scene, told; at last the whole of it. Closing it early frees everything.

    Args:
        first: was asked for already, so that a scene that is not let in gets a plain problem.
        events: what follows.
        tell: the words of the endpoint.
        metrics: where a failure is counted, as no status shows it.

    Raises:
        ProblemError: whatever went wrong; the status is sent, so nothing but an event can tell.
    """
    async with aclosing(events):
        try:
            event: SceneEvent | None = first
            while event is not None:
                if isinstance(event, PlannedScene):
                    yield event
                    return
                for each in await tell(event):
                    yield each
                event = await anext(events, None)
        except ProblemError as error:
            metrics.count_problem_within(error.kind)
            raise
        except Exception as error:
            log.exception("stream failed")
            failure = unforeseen()
            metrics.count_problem_within(failure.kind)
            raise failure from error


async def server_sent(
    told: AsyncGenerator[tuple[str, Data] | PlannedScene],
    answer: Callable[[PlannedScene], Awaitable[BaseModel]],
    request_id: str,
) -> AsyncGenerator[bytes]:
    """The bytes of a stream; ``answer`` makes the last event's data."""
    async with aclosing(told):
        try:
            async for event in told:
                if isinstance(event, PlannedScene):
                    yield _event("done", await answer(event))
                else:
                    yield _event(*event)
        except ProblemError as error:
            yield _event("error", problem_document(error, request_id))


async def streamed(
    request: Request,
    events: AsyncGenerator[SceneEvent],
    teller: Callable[[], Tell[Data]],
    sent: Callable[[AsyncGenerator[tuple[str, Data] | PlannedScene]], AsyncGenerator[bytes]],
    metrics: Metrics,
) -> StreamingResponse:
    """A scene's events as they come, in the words of a ``teller`` and the bytes that ``sent`` makes of these.

    Waits for the first event: so a scene that is not let in gets a status of its own. Only then is there a
    format that the teller can know.

    Raises:
        CallerLeft: before there was anything to send.
    """
    try:
        first = await while_connected(request, anext(events))
    except CallerLeft:
        await events.aclose()
        raise
    told = wire_events(first, events, teller(), metrics)
    return StreamingResponse(sent(told), media_type=wire.SSE_MEDIA_TYPE, headers=_NO_BUFFERING)


def _event(name: str, data: BaseModel) -> bytes:
    return format_sse_event(event=name, data_str=data.model_dump_json())
