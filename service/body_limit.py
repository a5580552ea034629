"""Request bodies that are too large, or come too slowly, are refused before they are kept."""

from __future__ import annotations

import asyncio
from typing import Final

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_DRAIN_FACTOR: Final = 4


class BodyLimit:
    """Ends a request with 413 when its body is read and turns out, or is announced, to be too large.

    With 408 when it is not there after ``timeout_s``.

    What still arrives of such a body is read and dropped, up to four times the limit: a server that answers
    and closes while the caller is still sending resets the connection, and the answer is lost.
    """

    def __init__(self, app: ASGIApp, max_bytes: int, timeout_s: float) -> None:
        self._app, self._max_bytes, self._timeout_s = app, max_bytes, timeout_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection; anything but HTTP passes through."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        announced = headers.get("content-length", "")
        received, complete = 0, False
        ends_s = asyncio.get_running_loop().time() + self._timeout_s

        async def receive_within_limit() -> Message:
            nonlocal received, complete
            if complete:
                return await receive()  # which tells when the caller leaves
            if announced.isdigit() and int(announced) > self._max_bytes:
                # A caller that asks first has not begun to send.
                if headers.get("expect", "").lower() != "100-continue":
                    await self._drain(receive)
                raise self._too_large()
            try:
                async with asyncio.timeout_at(ends_s):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(408, f"it was not there after {self._timeout_s:g} s") from None
            complete = not message.get("more_body", False)
            received += len(message.get("body", b""))
            if received > self._max_bytes:
                if message.get("more_body", False):
                    await self._drain(receive)
                raise self._too_large()
            return message

        await self._app(scope, receive_within_limit, send)

    async def _drain(self, receive: Receive) -> None:
        dropped = 0
        while dropped <= _DRAIN_FACTOR * self._max_bytes:
            message = await receive()
            dropped += len(message.get("body", b""))
            if not message.get("more_body", False):
                return

    def _too_large(self) -> HTTPException:
        return HTTPException(413, f"at most {self._max_bytes} bytes are accepted")
