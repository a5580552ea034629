"""Answers as server-sent events, while draws are being written."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from typing import Final

import structlog
from fastapi.sse import format_sse_event
from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import StreamingResponse

import clients.wire as wire
from model.driving.plan import Plan
from model.engines.engine import (
    DraftFinished,
    SectionFinished,
    TextWritten,
)
from model.families.family import Family
from model.families.registry import family_named
from model.formats.pieces import Values
from service.answers import wire_branch, wire_plan, wire_times, wire_trajectory
from service.callers import CallerLeft, while_connected
from service.errors import problem_document
from service.metrics import Metrics
from service.planning import Judged, Planned
from service.planning import Told as Happened
from service.problems import ProblemError, unforeseen

log = structlog.stdlib.get_logger()

_NO_BUFFERING: Final = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
"""Proxies must not hold events back."""

Written = wire.PlanWritten | wire.BranchTaken | wire.ThinkingWritten | wire.TrajectoryWritten
"""The data of an event."""
Told = tuple[str, Written] | Planned
"""An event of `clients.wire.EVENTS` with its data; at last the whole scene."""


async def told_events(
    first: Happened, events: AsyncGenerator[Happened], format: str, metrics: Metrics
) -> AsyncGenerator[Told]:
    """What happens to a scene in the wire's words; closing it early frees everything.

    Args:
        first: was asked for already, so that a scene that is not let in gets a plain problem.
        events: what follows.
        format: that the response is in.
        metrics: where a failure is counted, as no status shows it.

    Raises:
        ProblemError: whatever went wrong; the status is sent, so nothing but an event can tell.
    """
    told: dict[int, str] = {}
    family = family_named(format)
    async with aclosing(events):
        try:
            event: Happened | None = first
            while event is not None:
                if isinstance(event, Planned):
                    yield event
                    return
                for each in _data(event, family, told):
                    yield each
                event = await anext(events, None)
        except ProblemError as error:
            metrics.problem_told_within(error.kind)
            raise
        except Exception as error:
            log.exception("stream failed")
            failure = unforeseen()
            metrics.problem_told_within(failure.kind)
            raise failure from error


async def server_sent(
    told: AsyncGenerator[Told], answer: Callable[[Planned], BaseModel], request_id: str
) -> AsyncGenerator[bytes]:
    """The bytes of a stream; ``answer`` makes the last event's data."""
    async with aclosing(told):
        try:
            async for event in told:
                yield _event("done", answer(event)) if isinstance(event, Planned) else _event(*event)
        except ProblemError as error:
            yield _event("error", problem_document(error, request_id))


async def streamed(
    request: Request,
    events: AsyncGenerator[Happened],
    sent: Callable[[AsyncGenerator[Told]], AsyncGenerator[bytes]],
    format: str,
    metrics: Metrics,
) -> StreamingResponse:
    """A scene's events as they come, in the bytes that ``sent`` makes of them.

    Waits for the first event: so a scene that is not let in gets a status of its own.

    Raises:
        CallerLeft: before there was anything to send.
    """
    try:
        first = await while_connected(request, anext(events))
    except CallerLeft:
        await events.aclose()
        raise
    told = told_events(first, events, format, metrics)
    return StreamingResponse(sent(told), media_type=wire.SSE_MEDIA_TYPE, headers=_NO_BUFFERING)


def _data(event: Happened, family: Family, told: dict[int, str]) -> list[tuple[str, Written]]:
    match event:
        case TextWritten(index, section, text) if section == family.reflection:
            # Words that are made of values are told when these are there.
            return [] if family.reflection_text is not None else _text(index, text, told)
        case SectionFinished(index, section, _, values) if section == family.reflection:
            words = family.reflected(Values({section: values})) or ""
            return _text(index, words.removeprefix(told.get(index, "")), told)
        case SectionFinished(index, section, _, values) if family.branch and section == family.branch.name:
            branch = wire_branch(looked_twice=family.branch.reflecting in values)
            return [("branch", wire.BranchTaken(index=index, branch=branch))]
        case SectionFinished(index, section, _, (Plan() as plan, *_)) if section in family.plans:
            name = "plan" if section == family.first_plan else "revised_plan"
            return [(name, wire.PlanWritten(index=index, plan=wire_plan(plan)))]
        case DraftFinished(draw):
            trajectory = wire.TrajectoryWritten(
                index=draw.index, trajectory=wire_trajectory(draw), times_s=wire_times(draw)
            )
            return [("draft_trajectory", trajectory)]
        case Judged(draw, agreement):
            trajectory = wire.TrajectoryWritten(
                index=draw.index,
                trajectory=wire_trajectory(draw),
                times_s=wire_times(draw),
                consistent=agreement.consistent,
                disagreements=list(agreement.disagreements),
            )
            return [("trajectory", trajectory)]
    return []


def _text(index: int, text: str, told: dict[int, str]) -> list[tuple[str, Written]]:
    if not text:
        return []
    told[index] = told.get(index, "") + text
    return [("thinking", wire.ThinkingWritten(index=index, text=text))]


def _event(name: str, data: BaseModel) -> bytes:
    return format_sse_event(event=name, data_str=data.model_dump_json())
