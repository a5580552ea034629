"""What streams of the planning service tell, event by event."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import httpx
from httpx_sse import ServerSentEvent
from pydantic import BaseModel, ValidationError

from clients import wire, wire_imagine
from clients.answers import BadAnswer, PlanResult, ReflectResult, planned, reflected, typed

Told = (
    wire.PlanWritten
    | wire.BranchTaken
    | wire.ThinkingWritten
    | wire.TrajectoryWritten
    | PlanResult
    | ReflectResult
)
"""What a stream of plans or reflections tells; see `clients.wire.EVENTS`."""
ImagineTold = (
    wire_imagine.PerceptionWritten
    | wire_imagine.PredictionWritten
    | wire_imagine.CodesWritten
    | wire_imagine.Picture
    | wire_imagine.ImagineResponse
)
"""What a stream of pictures tells; see `clients.wire_imagine.EVENTS`."""

_Data = TypeVar("_Data", bound=BaseModel)
_Done = TypeVar("_Done")


def told(event: ServerSentEvent, response: httpx.Response) -> Told | None:
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

    return _told(event, response, wire.EVENTS, done)


def told_of_pictures(event: ServerSentEvent, response: httpx.Response) -> ImagineTold | None:
    """The same of a stream of pictures."""
    return _told(event, response, wire_imagine.EVENTS, wire_imagine.ImagineResponse.model_validate_json)


def _told(
    event: ServerSentEvent,
    response: httpx.Response,
    events: Mapping[str, type[_Data | wire.Problem]],
    done: Callable[[str], _Done],
) -> _Data | _Done | None:
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
