"""What happens around every request: its id, its log line, its count, and the answer to the unforeseen."""

from __future__ import annotations

import asyncio
import re
import secrets
import time
from collections.abc import Callable
from typing import Final

import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from looktwice.clients.wire import REQUEST_ID_HEADER
from looktwice.service.http.problem_documents import problem_response
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.operations.traces import Traces
from looktwice.service.problems import DRAINING, ProblemError, unforeseen

_SANE_REQUEST_ID: Final = re.compile(r"[A-Za-z0-9._:-]{1,128}")
_QUIET: Final = frozenset({"/healthz", "/readyz", "/metrics"})
_METHODS: Final = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_NO_ROUTE: Final = "(none)"

log = structlog.stdlib.get_logger()


class Around:
    """Pure ASGI, so that answers stream and the disconnect message reaches the routes.

    Args:
        app: what is around.
        metrics, traces: where requests are counted and traced.
        stopping: whether the service is about to stop.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, traces: Traces, stopping: Callable[[], bool]) -> None:
        self._app, self._metrics, self._traces, self._stopping = app, metrics, traces, stopping

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection; anything but HTTP passes through."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = Headers(scope=scope).get(REQUEST_ID_HEADER, "")
        request_id = given if _SANE_REQUEST_ID.fullmatch(given) else secrets.token_hex(8)
        began_s = time.monotonic()
        scope.setdefault("state", {}).update(request_id=request_id, since_s=began_s)
        status = 0

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers[REQUEST_ID_HEADER] = request_id
                if self._stopping():
                    headers["Connection"] = "close"  # or the next request meets a server that has gone
            await send(message)

        method = scope["method"] if scope["method"] in _METHODS else "other"
        with (
            structlog.contextvars.bound_contextvars(request_id=request_id),
            self._traces.request(
                method, scope["path"], Headers(scope=scope), quiet=scope["path"] in _QUIET
            ) as span,
        ):
            try:
                await self._app(scope, receive, send_with_id)
            except Exception:
                log.exception("request failed")
                if status:  # too late for another answer; the server breaks the connection
                    raise
                await problem_response(unforeseen(), request_id, scope["path"])(scope, receive, send_with_id)
            except asyncio.CancelledError:
                # The server's last word at the end of a drain; whoever waits is better asking elsewhere.
                # At other times it is the caller who ends it, in this very process.
                if status or not self._stopping():
                    raise
                stopped = ProblemError(DRAINING, "the service stopped before this was answered; ask another")
                await problem_response(stopped, request_id, scope["path"])(scope, receive, send_with_id)
            finally:
                route = getattr(scope.get("route"), "path", None)
                span.answered(route, status)
                self._account(scope, method, route, status, time.monotonic() - began_s)

    def _account(self, scope: Scope, method: str, route: str | None, status: int, seconds: float) -> None:
        endpoint = route or _NO_ROUTE
        self._metrics.request_answered(endpoint, method, status, seconds)
        if endpoint not in _QUIET:
            log.info(
                "request",
                method=method,
                path=scope["path"],
                status=status,
                owner=scope.get("state", {}).get("owner"),
                client=scope["client"][0] if scope["client"] else None,
                milliseconds=round(1000 * seconds, 1),
            )
