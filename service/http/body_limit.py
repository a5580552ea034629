"""Request bodies that are too large, or come too slowly, are refused before they are kept."""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress
from typing import Final

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_DRAIN_FACTOR: Final = 4
LARGE_BYTES: Final = 1_000_000
"""Ten scenes of the bundled size. Larger bodies share a part of what is held: small ones always find room."""
_LARGE_SHARE: Final = 4


class _ByteRate:
    """Lets so many bytes a second pass, and as many as ``at_once`` after a pause."""

    def __init__(self, bytes_per_s: int, at_once: int) -> None:
        self._bytes_per_s, self._ahead_s = bytes_per_s, at_once / bytes_per_s
        self._paid_s = -math.inf

    def take(self, count: int) -> float:
        """Count so many bytes that passed; from when on, in s of the loop, their sender may go on."""
        now_s = asyncio.get_running_loop().time()
        self._paid_s = max(self._paid_s, now_s - self._ahead_s) + count / self._bytes_per_s
        return self._paid_s


class BodyLimit:
    """Ends a request with 413 when its body is read and turns out, or is announced, to be too large.

    With 408 when it is not there after ``timeout_s``, and with 429 when the bodies of all requests under way
    together would be more than ``max_held_bytes``, or the large ones more than a quarter of that (but one is
    always taken): a place is reserved only once a body is read.

    Of large bodies at most ``large_bytes_per_s`` are read, after as many at once as one may have: reading
    takes the interpreter, which the engine needs. What is not read yet waits with its sender.

    What still arrives of such a body within that time is read and dropped, up to four times the limit: a
    server that answers and closes while the caller is still sending resets the connection, and the answer is
    lost.
    """

    def __init__(
        self, app: ASGIApp, max_bytes: int, max_held_bytes: int, large_bytes_per_s: int, timeout_s: float
    ) -> None:
        self._app, self._timeout_s = app, timeout_s
        self._max_bytes, self._max_held_bytes, self._held_bytes = max_bytes, max_held_bytes, 0
        self._max_large_bytes, self._large_bytes = max(max_bytes, max_held_bytes // _LARGE_SHARE), 0
        self._byte_rate = _ByteRate(large_bytes_per_s, max_bytes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection; anything but HTTP passes through."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        announced = headers.get("content-length", "")
        received, complete, goes_on_s = 0, False, 0.0
        ends_s = asyncio.get_running_loop().time() + self._timeout_s

        async def receive_within_limit() -> Message:
            nonlocal received, complete, goes_on_s
            if complete:
                return await receive()  # which tells when the caller leaves
            if announced.isdigit() and _more(announced, self._max_bytes):
                # A caller that asks first has not begun to send.
                if headers.get("expect", "").lower() != "100-continue":
                    await self._drain(receive, ends_s)
                raise self._too_large()
            try:
                async with asyncio.timeout_at(ends_s):
                    await _until(goes_on_s)
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, f"it was not there after {self._timeout_s:g} s") from None
            complete = not message.get("more_body", False)
            before, received = received, received + len(message.get("body", b""))
            self._held_bytes += received - before
            if large := _large(received) - _large(before):
                self._large_bytes += large
                goes_on_s = self._byte_rate.take(large)
            too_large = received > self._max_bytes
            too_many = self._too_many(received)
            if (too_large or too_many is not None) and not complete:
                self._forget(received)
                received = 0
                await self._drain(receive, ends_s)
            if too_large:
                raise self._too_large()
            if too_many is not None:
                raise HTTPException(429, too_many, {"Retry-After": "1"})
            return message

        try:
            await self._app(scope, receive_within_limit, send)
        finally:
            self._forget(received)

    def _forget(self, received: int) -> None:
        self._held_bytes -= received
        self._large_bytes -= _large(received)

    def _too_many(self, received: int) -> str | None:
        """Why a body of which so many bytes are there is more than can be held; None where it is not."""
        if self._held_bytes > self._max_held_bytes:
            return f"the bodies of all requests together hold at most {self._max_held_bytes} bytes"
        if received > LARGE_BYTES and self._large_bytes > self._max_large_bytes:
            return (
                f"bodies of more than {LARGE_BYTES} bytes together hold at most {self._max_large_bytes} bytes"
            )
        return None

    async def _drain(self, receive: Receive, ends_s: float) -> None:
        dropped, goes_on_s = 0, 0.0
        with suppress(TimeoutError):
            async with asyncio.timeout_at(ends_s):
                while dropped <= _DRAIN_FACTOR * self._max_bytes:
                    await _until(goes_on_s)
                    message = await receive()
                    count = len(message.get("body", b""))
                    dropped += count
                    goes_on_s = self._byte_rate.take(count)
                    if not message.get("more_body", False):
                        return

    def _too_large(self) -> HTTPException:
        return HTTPException(413, f"at most {self._max_bytes} bytes are accepted")


def _more(announced: str, most: int) -> bool:
    """Whether a number in digits is larger; its length alone may tell, and Python reads no endless ones."""
    digits = announced.lstrip("0")
    return len(digits) > len(str(most)) or int(digits or "0") > most


async def _until(time_s: float) -> None:
    """Sleep until then, in s of the loop."""
    if (wait_s := time_s - asyncio.get_running_loop().time()) > 0:
        await asyncio.sleep(wait_s)


def _large(received: int) -> int:
    """Bytes of a body that count among those of large ones."""
    return received if received > LARGE_BYTES else 0
