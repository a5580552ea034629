"""One request over HTTP, and what became of it."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Final

import httpx
from httpx_sse import EventSource, SSEError

from looktwice.loadtests.exchange import BAD_ANSWER, Call, Exchange, Verdict, read_answer, refusal

_FIRST: Final = ("plan", "picture")
"""Events that somebody waits for; a stream has one of the two."""


@dataclass(frozen=True)
class ServiceTarget:
    """Where requests go.

    Attributes:
        url: of the service.
        api_key: sent as a bearer token; empty for none.
        timeout_s: after which an answer is no longer waited for.
    """

    url: str
    api_key: str = ""
    timeout_s: float = 30.0

    @property
    def headers(self) -> dict[str, str]:
        """That every request carries."""
        return {"Authorization": f"Bearer {self.api_key}"} if self.api_key else {}


class Sender:
    """Sends calls on the clock of a run that began at ``starts_at``, as `time.monotonic` tells it."""

    def __init__(self, http: httpx.AsyncClient, timeout_s: float, starts_at: float) -> None:
        self._http, self._timeout_s, self._starts_at = http, timeout_s, starts_at

    def now_s(self) -> float:
        """Seconds since the run began."""
        return time.monotonic() - self._starts_at

    async def wait_until(self, due_s: float) -> None:
        """Sleep; others get their turn even where it is late already."""
        await asyncio.sleep(max(0.0, due_s - self.now_s()))

    async def send(self, call: Call, due_s: float) -> Exchange:
        """Send ``call`` now and wait for its answer; whatever goes wrong is part of the exchange."""
        sent_s = self.now_s()
        first_plan_s: float | None = None
        try:
            async with asyncio.timeout(self._timeout_s):
                request = self._http.build_request("POST", call.path, headers=call.headers, content=call.body)
                response = await self._http.send(request, stream=call.kind.stream)
                if call.kind.stream:
                    verdict, first_plan_s = await self._read_stream(call, response)
                ended_s = self.now_s()
                # Read after the clock was: what it takes is not the service's.
                if not call.kind.stream:
                    verdict = read_answer(call.kind, response.status_code, response.content)
        except TimeoutError:
            ended_s, verdict = self.now_s(), Verdict("failed", "timeout")
        except httpx.HTTPError as error:
            ended_s, verdict = self.now_s(), Verdict("failed", type(error).__name__)
        return Exchange(call.kind, due_s, sent_s, ended_s, verdict, first_plan_s)

    async def _read_stream(self, call: Call, response: httpx.Response) -> tuple[Verdict, float | None]:
        """The verdict on a stream's end, and when its first plan or picture was there."""
        first_plan_s: float | None = None
        try:
            if response.status_code != 200:
                return refusal(response.status_code, await response.aread()), None
            async for event in EventSource(response).aiter_sse():
                if event.event in _FIRST and first_plan_s is None:
                    first_plan_s = self.now_s()
                elif event.event == "done":
                    return read_answer(call.kind, 200, event.data.encode()), first_plan_s
                elif event.event == "error":
                    return _told(event.data), first_plan_s
            return Verdict("failed", "stream-broke-off"), first_plan_s
        except SSEError:
            return BAD_ANSWER, first_plan_s
        finally:
            await response.aclose()


def _told(data: str) -> Verdict:
    """The verdict on a stream's error event, which is a problem document."""
    try:
        status = int(json.loads(data)["status"])
    except (ValueError, KeyError, TypeError):
        return BAD_ANSWER
    return refusal(status, data.encode())


@asynccontextmanager
async def connected(target: ServiceTarget) -> AsyncIterator[httpx.AsyncClient]:
    """A client that opens as many connections as requests are under way, and goes straight to the service."""
    limits = httpx.Limits(max_connections=None, max_keepalive_connections=None, keepalive_expiry=60)
    async with httpx.AsyncClient(
        base_url=target.url, headers=target.headers, limits=limits, timeout=None, trust_env=False
    ) as http:
        yield http
