"""What both planner clients share: how long they try, and how they speak to the service."""

from __future__ import annotations

import base64
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self, TypedDict

import httpx
import msgpack
from pydantic import BaseModel

from looktwice.clients import wire
from looktwice.clients.answers import BUSY_STATUSES, retry_after_s, unreachable
from looktwice.clients.wire_values import with_pictures


@dataclass(frozen=True)
class RetryPolicy:
    """How long a client tries.

    Attributes:
        timeout_s: for one attempt, connecting included.
        attempts: at most, the first one included. Only 429 and 503 answers that say how long to wait are
            tried again, and never beyond a request's own ``deadline_ms``.
        longest_wait_s: a longer Retry-After is reported instead of waited for.
    """

    timeout_s: float = 30.0
    attempts: int = 3
    longest_wait_s: float = 5.0


@dataclass(frozen=True)
class Access:
    """How a client speaks to the service.

    Attributes:
        api_key: sent as a bearer token; None where the service asks for none.
        packed: send bodies in msgpack, pictures as they are: smaller and quicker to read than JSON.
    """

    api_key: str | None = None
    packed: bool = False

    @classmethod
    def from_environment(cls) -> Self:
        """With the key in ``LOOKTWICE_API_KEY``, where one is set."""
        return cls(os.environ.get("LOOKTWICE_API_KEY") or None)


class Tries:
    """Decides, without waiting itself, whether and when to try again."""

    def __init__(self, retries: RetryPolicy, deadline_ms: int | None) -> None:
        self._left = retries.attempts
        self._longest_wait_s = retries.longest_wait_s
        self._ends = None if deadline_ms is None else time.monotonic() + deadline_ms / 1000

    def wait_after(self, response: httpx.Response) -> float | None:
        """Seconds to wait before the next attempt; None when ``response`` is the last word."""
        self._left -= 1
        wait_s = retry_after_s(response)
        if response.status_code not in BUSY_STATUSES or wait_s is None or self._left <= 0:
            return None
        if wait_s > self._longest_wait_s or (self._ends and time.monotonic() + wait_s > self._ends):
            return None
        return wait_s


class SentBody(TypedDict):
    """A request's bytes, and the headers that say how to read them."""

    content: bytes
    headers: dict[str, str]


def body_of(asked: BaseModel, request_id: str | None = None, *, packed: bool) -> SentBody:
    """A request as it is sent, in JSON or packed in msgpack; ``request_id`` shows up in the service's log."""
    media_type = wire.MSGPACK_MEDIA_TYPE if packed else "application/json"
    headers = {"Content-Type": media_type}
    if request_id is not None:
        headers[wire.REQUEST_ID_HEADER] = request_id
    content = _packed(asked) if packed else asked.model_dump_json().encode()
    return SentBody(content=content, headers=headers)


def _packed(asked: BaseModel) -> bytes:
    content: bytes = msgpack.packb(with_pictures(asked.model_dump(), base64.b64decode))
    return content


def headers_of(access: Access) -> dict[str, str]:
    """Headers of every request: the key, where there is one."""
    return {} if access.api_key is None else {"Authorization": f"Bearer {access.api_key}"}


@contextmanager
def typed_errors() -> Iterator[None]:
    """Tells of a request that got no answer as `looktwice.clients.answers.PlannerUnreachable`."""
    try:
        yield
    except httpx.HTTPError as error:
        raise unreachable(error) from error
