"""The API's description: problem documents declared where they can occur, under their media type."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from clients.wire import PROBLEM_MEDIA_TYPE, Problem
from service.problems import INTERNAL, Kind

Responses = dict[int | str, dict[str, Any]]


def problems(*kinds: Kind) -> Responses:
    """What a route declares about its errors; 500 can occur anywhere."""
    by_status: dict[int, list[Kind]] = {}
    for kind in (*kinds, INTERNAL):
        by_status.setdefault(kind.status, []).append(kind)
    return {
        status: {
            "model": Problem,
            "description": "; ".join(kind.title for kind in found),
            "content": {
                PROBLEM_MEDIA_TYPE: {"examples": {kind.slug: {"value": _example(kind)} for kind in found}}
            },
        }
        for status, found in sorted(by_status.items())
    }


def describe(app: FastAPI) -> None:
    """Make ``app`` describe problems as ``application/problem+json``; FastAPI files models under JSON."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            description = generate()
            for path in description["paths"].values():
                for operation in path.values():
                    _move_problems(operation["responses"])
            for unused in ("HTTPValidationError", "ValidationError"):
                description["components"]["schemas"].pop(unused, None)
        return generate()

    app.openapi = openapi  # type: ignore[method-assign]


def _move_problems(responses: dict[str, dict[str, Any]]) -> None:
    for status, response in list(responses.items()):
        content = response.get("content", {})
        if PROBLEM_MEDIA_TYPE in content:
            content[PROBLEM_MEDIA_TYPE] |= content.pop("application/json", {})
        elif status == "422":  # FastAPI's own, which the error handlers replace
            del responses[status]


def _example(kind: Kind) -> dict[str, Any]:
    return {
        "type": kind.type,
        "title": kind.title,
        "status": kind.status,
        "detail": "…",
        "request_id": "0f3a5c",
    }
