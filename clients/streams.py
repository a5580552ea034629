"""What streams of the planning service tell, event by event."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar, cast

import httpx
from httpx_sse import ServerSentEvent
from pydantic import BaseModel, ValidationError

from looktwice.clients import wire, wire_imagine, wire_refine
from looktwice.clients.answers import BadAnswer, PlanResult, ReflectResult, planned, reflected, typed

PlanEvent = (
    wire.PlanWritten
    | wire.BranchTaken
    | wire.ThinkingWritten
    | wire.SectionWritten
    | wire.TrajectoryWritten
    | PlanResult
    | ReflectResult
)
"""What a stream of plans or reflections tells; see `looktwice.clients.wire.EVENTS`."""
ImagineEvent = (
    wire_imagine.PerceptionWritten
    | wire_imagine.PredictionWritten
    | wire_imagine.CodesWritten
    | wire_imagine.Picture
    | wire_imagine.ImagineResponse
)
"""What a stream of pictures tells; see `looktwice.clients.wire_imagine.EVENTS`."""
RefineEvent = (
    wire_refine.DraftJudged
    | wire.PlanWritten
    | wire.BranchTaken
    | wire.ThinkingWritten
    | wire.SectionWritten
    | wire.TrajectoryWritten
    | wire_refine.RefineResponse
)
"""What a stream of refinements tells; see `looktwice.clients.wire_refine.EVENTS`."""

_Event = TypeVar("_Event")
Tell = Callable[[ServerSentEvent, httpx.Response], _Event | None]
"""Makes of an event of a response what it tells; None for an event of a later version."""


def plan_event(event: ServerSentEvent, response: httpx.Response) -> PlanEvent | None:
    """What an event of a stream of plans or reflections tells; None for one of a later version.

    Args:
        event: of the stream.
        response: that it came in; its path decides what the last event holds.

    Raises:
        PlannerError: the event is an error, or not of the contract.
    """

    def done(data: str) -> PlanResult | ReflectResult:
        if response.url.path == "/v1/reflect":
            return reflected(wire.ReflectResponse.model_validate_json(data), response)
        return planned(wire.PlanResponse.model_validate_json(data), response)

    return cast("PlanEvent | None", _event(event, response, wire.EVENTS, done))


def imagine_event(event: ServerSentEvent, response: httpx.Response) -> ImagineEvent | None:
    """The same of a stream of pictures."""
    done = wire_imagine.ImagineResponse.model_validate_json
    return cast("ImagineEvent | None", _event(event, response, wire_imagine.EVENTS, done))


def refine_event(event: ServerSentEvent, response: httpx.Response) -> RefineEvent | None:
    """The same of a stream of refinements."""
    done = wire_refine.RefineResponse.model_validate_json
    return cast("RefineEvent | None", _event(event, response, wire_refine.EVENTS, done))


def _event(
    event: ServerSentEvent,
    response: httpx.Response,
    events: Mapping[str, type[BaseModel]],
    done: Callable[[str], object],
) -> object:
    name = event.event
    try:
        if name == "done":
            return done(event.data)
        if name not in events:
            return None
        data = events[name].model_validate_json(event.data)
    except ValidationError as error:
        raise BadAnswer(f"{response.url} told of something else than {name}: {error}") from error
    if isinstance(data, wire.Problem):
        raise typed(data)
    return data
