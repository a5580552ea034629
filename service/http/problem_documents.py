"""Every error of the service as a problem document (RFC 9457)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final, TypeVar

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response

from looktwice.clients.wire import PROBLEM_MEDIA_TYPE, Fault, Problem
from looktwice.service.http.callers import CALLER_LEFT_STATUS, CallerLeft
from looktwice.service.http.dialect import dialect_error, dialect_status, in_dialect
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.problems import (
    BODY_TIMEOUT,
    BODY_TOO_LARGE,
    INTERNAL,
    INVALID_ATTEMPT,
    INVALID_CLIP,
    INVALID_CONTROLS,
    INVALID_FEEDBACK,
    INVALID_HISTORY,
    INVALID_JSON,
    INVALID_LABELS,
    INVALID_PLAN,
    INVALID_REQUEST,
    INVALID_ROUTE,
    INVALID_TRACKS,
    INVALID_TRAJECTORY,
    METHOD_NOT_ALLOWED,
    NOT_FOUND,
    QUEUE_FULL,
    UNAUTHORIZED,
    UNKNOWN_CAMERA,
    UNKNOWN_FIELD,
    UNSUPPORTED_MEDIA_TYPE,
    ProblemError,
    ProblemKind,
)

_Model = TypeVar("_Model", bound=BaseModel)
_MAX_FAULTS: Final = 20
_MAX_QUOTED: Final = 200
"""Characters."""

# The kind of a schema violation is that of the first place that fits.
_KIND_BY_PLACE: Final[Sequence[tuple[tuple[str, ...], ProblemKind]]] = (
    (("scene", "clips"), INVALID_CLIP),
    (("scene", "history"), INVALID_HISTORY),
    (("scene", "route"), INVALID_ROUTE),
    (("scene", "tracks"), INVALID_TRACKS),
    (("plan",), INVALID_PLAN),
    (("predicted_plan",), INVALID_PLAN),
    (("expert_plan",), INVALID_PLAN),
    (("controls", "prefill"), INVALID_PLAN),
    (("controls",), INVALID_CONTROLS),
    (("attempt",), INVALID_ATTEMPT),
    (("labels",), INVALID_LABELS),
    *(
        ((field,), INVALID_TRAJECTORY)
        for field in (
            *("trajectories", "reference", "previous", "human", "ground_truth", "draft"),
            *("trajectory", "times_s"),
        )
    ),
    (("said", "written"), INVALID_FEEDBACK),
    (("feedback",), INVALID_FEEDBACK),
)
_KIND_BY_STATUS: Final = {
    kind.status: kind
    for kind in (
        *(INVALID_JSON, NOT_FOUND, METHOD_NOT_ALLOWED, BODY_TIMEOUT, BODY_TOO_LARGE),
        *(UNSUPPORTED_MEDIA_TYPE, QUEUE_FULL),
    )
}


def install_error_handlers(app: FastAPI, metrics: Metrics) -> None:
    """Answer every error of ``app`` with a problem document; what is not foreseen, the middleware answers."""

    def answer(request: Request, problem: ProblemError, headers: dict[str, str] | None = None) -> Response:
        metrics.count_problem(problem.kind)
        return problem_response(problem, request.state.request_id, request.url.path, headers)

    @app.exception_handler(ProblemError)
    async def _problem(request: Request, error: ProblemError) -> Response:
        return answer(request, error)

    @app.exception_handler(RequestValidationError)
    async def _validation(request: Request, error: RequestValidationError) -> Response:
        return answer(request, from_validation(error))

    @app.exception_handler(CallerLeft)
    @app.exception_handler(ClientDisconnect)
    async def _left(request: Request, error: CallerLeft | ClientDisconnect) -> Response:
        return Response(status_code=CALLER_LEFT_STATUS)

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> Response:
        kind = _KIND_BY_STATUS.get(error.status_code, INTERNAL)
        problem = ProblemError(kind, _http_detail(kind, request, error))
        return answer(request, problem, dict(error.headers or {}))


def problem_response(
    error: ProblemError,
    request_id: str,
    path: str,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """The answer to a request to ``path`` that ended with ``error``; OpenAI's clients may read it there."""
    kind = error.kind
    extra = dict(headers or {})
    if error.retry_after_s is not None:
        extra["Retry-After"] = str(error.retry_after_s)
    if kind is BODY_TIMEOUT:
        extra["Connection"] = "close"
    # Plain ASCII: details quote what callers sent, which need not be encodable otherwise.
    document = problem_document(error, request_id).model_dump(exclude_defaults=True)
    if in_dialect(path):
        document["status"] = dialect_status(kind.status)
        document["error"] = dialect_error(error)
    response = Response(json.dumps(document), document["status"], extra, media_type=PROBLEM_MEDIA_TYPE)
    if kind is UNAUTHORIZED:
        # A line for each: browsers look at the first word of a line only.
        for scheme in ("Bearer", "Basic"):
            response.headers.append("WWW-Authenticate", f'{scheme} realm="LookTwice"')
    return response


def problem_document(error: ProblemError, request_id: str) -> Problem:
    """``error`` for the wire."""
    return Problem(
        type=error.kind.type,
        title=error.kind.title,
        status=error.kind.status,
        detail=error.detail,
        request_id=request_id,
        errors=list(error.errors),
    )


def _http_detail(kind: ProblemKind, request: Request, error: HTTPException) -> str:
    path = request.url.path
    if kind is METHOD_NOT_ALLOWED:
        allowed = (error.headers or {}).get("Allow", "")
        return f"{request.method} {path} does not exist" + (f"; allowed: {allowed}" if allowed else "")
    if kind is NOT_FOUND:
        return f"{path} does not exist; /openapi.json lists what does"
    return str(error.detail)


def from_validation(error: RequestValidationError) -> ProblemError:
    """The problem that a body has which breaks its schema."""
    if isinstance(error.body, bytes):
        return ProblemError(
            UNSUPPORTED_MEDIA_TYPE,
            "send the body as application/json, application/msgpack or multipart/form-data",
        )
    found = error.errors()
    first = found[0]
    if first["type"] == "json_invalid":
        return ProblemError(
            INVALID_JSON, f"not JSON at character {first['loc'][-1]}: {first['ctx']['error']}"
        )
    faults = [
        Fault(pointer=_pointer(fault["loc"][1:], error.body), detail=_shortened(fault["msg"]))
        for fault in found[:_MAX_FAULTS]
    ]
    detail = f"{faults[0].pointer or 'body'}: {faults[0].detail}"
    if len(found) > 1:
        detail += f" (and {len(found) - 1} more)"
    return ProblemError(_kind(first), detail, faults)


def validated(model: type[_Model], document: object) -> _Model:
    """``document`` as a body of kind ``model``; raises the `ProblemError` that it would meet as a body."""
    try:
        return model.model_validate(document)
    except ValidationError as error:
        found = [fault | {"loc": ("body", *fault["loc"])} for fault in error.errors(include_url=False)]
        raise from_validation(RequestValidationError(found, body=document)) from None


def _kind(fault: dict[str, Any]) -> ProblemKind:
    place = tuple(part for part in fault["loc"][1:] if isinstance(part, str))
    if place[:1] == ("requests",):
        place = place[1:]
    if fault["type"] == "extra_forbidden":
        return UNKNOWN_FIELD
    if place[-1:] == ("camera",) and fault["type"] == "literal_error":
        return UNKNOWN_CAMERA
    for start, kind in _KIND_BY_PLACE:
        if place[: len(start)] == start:
            return kind
    return INVALID_REQUEST


def _pointer(location: Sequence[str | int], body: object) -> str:
    """RFC 6901 pointer into ``body``; names of union branches, which pydantic adds, are left out."""
    parts: list[str] = []
    node: object = body
    for position, part in enumerate(location):
        if _holds(node, part):
            node = node[part]  # type: ignore[index]  # it was just asked
        elif position < len(location) - 1 or not isinstance(node, dict):
            continue
        parts.append(_shortened(str(part).replace("~", "~0").replace("/", "~1")))
    return "".join(f"/{part}" for part in parts)


def _shortened(text: str) -> str:
    """As much of a caller's own words as an answer quotes."""
    return text if len(text) <= _MAX_QUOTED else f"{text[:_MAX_QUOTED]}…"


def _holds(node: object, part: str | int) -> bool:
    if isinstance(node, list):
        return isinstance(part, int) and part < len(node)
    return isinstance(node, dict) and part in node
