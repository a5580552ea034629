"""When requests came, and whose they are."""

from __future__ import annotations

from fastapi import Request

from looktwice.service.planning.events import Arrival


def arrival_of(request: Request) -> Arrival:
    """When and as what ``request`` came."""
    state = request.state
    return Arrival(state.request_id, state.owner, state.since_s)
