"""The API's description: problem documents declared where they can occur, under their media type."""

from __future__ import annotations

import threading
from typing import Any

from fastapi import FastAPI
from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from looktwice.clients.wire import (
    MSGPACK_MEDIA_TYPE,
    MULTIPART_MEDIA_TYPE,
    PROBLEM_MEDIA_TYPE,
    REQUEST_PART,
    SSE_MEDIA_TYPE,
    Problem,
)
from looktwice.service.http.auth import OPEN_PATHS
from looktwice.service.http.dialect import dialect_error, dialect_status
from looktwice.service.problems import INTERNAL, MISDIRECTED, ProblemError, ProblemKind

Responses = dict[int | str, dict[str, Any]]

_TAGS = {
    "planning": "plans, reflections and the models that make them",
    "labelling": "what a teacher says of plans",
    "scoring": "plans scored by NAVSIM's rules",
    "scenes": "bundled scenes, and those of a file",
    "operations": "health, readiness, metrics, models that are swapped",
}

PACKED: Responses = {
    200: {"content": {MSGPACK_MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}}
}
"""Of a route that answers in msgpack where that is accepted."""


def event_stream(description: str, *names: str) -> dict[str, Any]:
    """The content of a stream of server-sent events: what one of them is.

    Args:
        description: of the stream.
        names: that events have; none where they are told apart by their data alone.
    """
    fields: dict[str, Any] = {"data": {"type": "string", "description": "JSON."}}
    if names:
        fields["event"] = {"type": "string", "enum": list(names)}
    schema = {"type": "object", "description": description, "required": list(fields), "properties": fields}
    return {SSE_MEDIA_TYPE: {"schema": schema}}


def answers_and_stream(*names: str) -> Responses:
    """Of a route that answers in msgpack where that is accepted, and in events of these names on request."""
    stream = event_stream("With stream: true. One event of it.", *names, "done")
    return {200: {"content": PACKED[200]["content"] | stream}}


def problems(*kinds: ProblemKind, dialect: bool = False) -> Responses:
    """What a route declares about its errors; 421 and 500 can occur anywhere.

    Args:
        kinds: that it may answer with.
        dialect: whether it tells them as OpenAI's clients expect.
    """
    by_status: dict[int, list[ProblemKind]] = {}
    for kind in (*kinds, MISDIRECTED, INTERNAL):
        status = dialect_status(kind.status) if dialect else kind.status
        by_status.setdefault(status, []).append(kind)
    return {
        status: {
            "model": Problem,
            "description": "; ".join(kind.title for kind in found),
            "content": {
                PROBLEM_MEDIA_TYPE: {
                    "examples": {kind.slug: {"value": _example(kind, dialect=dialect)} for kind in found}
                }
            },
        }
        for status, found in sorted(by_status.items())
    }


def payloads(body: type[BaseModel]) -> dict[str, Any]:
    """What a route adds to its description for bodies that are not JSON."""
    schema = {"$ref": f"#/components/schemas/{body.__name__}"}
    parts = {
        "type": "object",
        "properties": {REQUEST_PART: schema},
        "required": [REQUEST_PART],
        "additionalProperties": {"type": "string", "format": "binary"},
    }
    content = {MSGPACK_MEDIA_TYPE: {"schema": schema}, MULTIPART_MEDIA_TYPE: {"schema": parts}}
    return {"requestBody": {"content": content}}


def describe(app: FastAPI, *, keys: bool) -> None:
    """Make ``app`` describe problems as ``application/problem+json``; FastAPI files models under JSON.

    Args:
        app: with all its routes.
        keys: whether it takes none but those with a key.
    """
    generate, describing = app.openapi, threading.Lock()

    def openapi() -> dict[str, Any]:
        with describing:
            return app.openapi_schema or described()

    def described() -> dict[str, Any]:
        description = generate()
        description["servers"] = [{"url": "/", "description": "where this description comes from"}]
        description["tags"] = [{"name": name, "description": text} for name, text in _TAGS.items()]
        for path, operations in description["paths"].items():
            for operation in operations.values():
                _move_problems(operation["responses"])
                if path in OPEN_PATHS:
                    del operation["responses"][str(MISDIRECTED.status)]
                elif keys:
                    operation["security"] = [{"key": []}]
        if keys:
            scheme = {"type": "http", "scheme": "bearer"}
            description["components"]["securitySchemes"] = {"key": scheme}
        for unused in ("HTTPValidationError", "ValidationError"):
            description["components"]["schemas"].pop(unused, None)
        return description

    def answer(_: Request) -> JSONResponse:
        return JSONResponse(app.openapi())

    app.openapi = openapi  # type: ignore[method-assign]
    # FastAPI's own route comes later: it does half a second of work in the event loop, this one in a thread.
    assert app.openapi_url is not None
    app.router.routes.insert(0, Route(app.openapi_url, answer, include_in_schema=False))


def _move_problems(responses: dict[str, dict[str, Any]]) -> None:
    for status, response in list(responses.items()):
        content = response.get("content", {})
        if PROBLEM_MEDIA_TYPE in content:
            content[PROBLEM_MEDIA_TYPE] |= content.pop("application/json", {})
        elif status == "422":  # FastAPI's own, which the error handlers replace
            del responses[status]


def _example(kind: ProblemKind, *, dialect: bool) -> dict[str, Any]:
    document = {
        "type": kind.type,
        "title": kind.title,
        "status": kind.status,
        "detail": "…",
        "request_id": "0f3a5c",
    }
    if dialect:
        document["status"] = dialect_status(kind.status)
        document["error"] = dialect_error(ProblemError(kind, "…"))
    return document
