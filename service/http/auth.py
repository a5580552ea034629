"""Nobody gets in without a key, or under a strange name, but to the probes."""

from __future__ import annotations

import base64
import binascii
from typing import Final

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from looktwice.service.http.problem_documents import problem_response
from looktwice.service.operations.keys import Keys
from looktwice.service.operations.service_metrics import Metrics
from looktwice.service.problems import MISDIRECTED, UNAUTHORIZED, ProblemError

OPEN_PATHS: Final = frozenset({"/healthz", "/readyz"})
"""Probes: whoever runs a service asks them without a key, and under its address of the moment."""
NOBODY: Final = ""
"""Whoever asks where no keys are set."""
_QUOTED: Final = 100
"""Characters of a name that is not this service's; longer ones are sent to be sent back."""


class Guard:
    """Lets nobody in without a key, but to the probes. Pure ASGI.

    The key comes as a bearer token; browsers, which cannot send one by themselves, may give it as the
    password of basic authentication, whatever the user's name.

    Where there are no keys, a page of anybody's could have the browser of a user ask under a name of its own
    that leads here (DNS rebinding): then only requests to ``hosts`` are served; None for any.
    """

    def __init__(
        self, app: ASGIApp, keys: Keys, metrics: Metrics, hosts: frozenset[str] | None = None
    ) -> None:
        self._app, self._keys, self._metrics, self._hosts = app, keys, metrics, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection; anything but HTTP passes through."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        if scope["path"] in OPEN_PATHS:
            scope["state"]["owner"] = NOBODY
            await self._app(scope, receive, send)
            return
        host = _host(Headers(scope=scope).get("host", ""))
        if not self._keys and self._hosts is not None and host not in self._hosts:
            detail = f"this is not {host[:_QUOTED]!r}; LOOKTWICE_HOSTS tells its names"
            await self._refuse(ProblemError(MISDIRECTED, detail), scope, receive, send)
            return
        owner: str | None = NOBODY
        if self._keys:
            key = _key(Headers(scope=scope).get("authorization", ""))
            owner = None if key is None else self._keys.owner(key)
        if owner is None:
            told = ProblemError(UNAUTHORIZED, "send a key of this service: Authorization: Bearer …")
            await self._refuse(told, scope, receive, send)
            return
        scope["state"]["owner"] = owner
        await self._app(scope, receive, send)

    async def _refuse(self, problem: ProblemError, scope: Scope, receive: Receive, send: Send) -> None:
        self._metrics.count_problem(problem.kind)
        answer = problem_response(problem, scope["state"]["request_id"], scope["path"])
        await answer(scope, receive, send)


def _host(given: str) -> str:
    """The name in a Host header, without its port."""
    if given.startswith("["):  # an address of IPv6
        return given.partition("]")[0].removeprefix("[").lower()
    return given.partition(":")[0].lower()


def _key(authorization: str) -> str | None:
    scheme, _, given = authorization.partition(" ")
    if scheme.lower() == "bearer":
        return given.strip()
    if scheme.lower() == "basic":
        try:
            return base64.b64decode(given.strip(), validate=True).decode().partition(":")[2]
        except (binascii.Error, UnicodeDecodeError, ValueError):
            return None
    return None
