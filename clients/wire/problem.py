"""Problem documents (RFC 9457): what every endpoint answers errors with."""

from __future__ import annotations

from pydantic import Field

from looktwice.clients.wire.base import ResponseModel


class Fault(ResponseModel):
    """One thing that is wrong with a request."""

    pointer: str = Field(description="JSON pointer (RFC 6901) into the body.")
    detail: str
    line: int | None = Field(default=None, description="Of a text in the body, from 1.")
    column: int | None = Field(default=None, description="In that line, from 1.")


class Problem(ResponseModel):
    """A problem document (RFC 9457)."""

    type: str = Field(description="Stable URI of the kind of problem.")
    title: str
    status: int
    detail: str = Field(description="What is wrong here, and what to change.")
    request_id: str
    errors: list[Fault] = Field(
        default_factory=list, description="Every fault found, where there are places."
    )
