"""Connections whose other end is slow, silent or greedy do not stay."""

from __future__ import annotations

import asyncio
import fcntl
import sys
import termios
from typing import Any, Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

_MAX_HEADER_BYTES: Final = 64 * 1024
_TOO_LARGE: Final = (
    b"HTTP/1.1 431 Request Header Fields Too Large\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"
)


def guarded_connection(
    headers_timeout_s: float, write_timeout_s: float, probes: frozenset[str] = frozenset()
) -> type[HttpToolsProtocol]:
    """uvicorn's connection with limits that it lacks.

    Args:
        headers_timeout_s: a connection is closed when the headers of its next request take longer, from the
            first byte, or from the beginning of the connection.
        write_timeout_s: it is cut off when the caller takes nothing of what waits for it for so long.
        probes: paths that are answered however many connections are open: a service that is full is not one
            to be restarted.
    """

    class GuardedConnection(HttpToolsProtocol):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            self._headers_timer: asyncio.TimerHandle | None = None
            self._write_timer: asyncio.TimerHandle | None = None
            self._header_bytes = 0

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            self._await_headers()

        def connection_lost(self, exc: Exception | None) -> None:
            self._headers_are_there()
            self._can_write()
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            answered = self.cycle is None or self.cycle.response_complete
            if answered and self._headers_timer is None:
                self._await_headers()
            super().data_received(data)
            if self._headers_timer is not None:
                self._header_bytes += len(data)
                if self._header_bytes > _MAX_HEADER_BYTES and not self.transport.is_closing():
                    self.transport.write(_TOO_LARGE)
                    self.transport.close()

        def on_headers_complete(self) -> None:
            self._headers_are_there()
            if self.url.partition(b"?")[0].decode("ascii", "replace") in probes:
                limit, self.limit_concurrency = self.limit_concurrency, None
                super().on_headers_complete()
                self.limit_concurrency = limit
            else:
                super().on_headers_complete()

        def pause_writing(self) -> None:
            super().pause_writing()
            self._await_writing()

        def resume_writing(self) -> None:
            self._can_write()
            super().resume_writing()

        def timeout_keep_alive_handler(self) -> None:
            if self.transport.get_write_buffer_size():
                self.transport.abort()  # closing would wait for a caller that does not read
            super().timeout_keep_alive_handler()

        def _await_headers(self) -> None:
            self._header_bytes = 0
            self._headers_timer = self.loop.call_later(headers_timeout_s, self.transport.abort)

        def _await_writing(self) -> None:
            waiting = _not_taken(self.transport)

            def look() -> None:
                if _not_taken(self.transport) < waiting:
                    self._await_writing()  # slow, but it takes what it is given
                else:
                    self.transport.abort()

            self._write_timer = self.loop.call_later(write_timeout_s, look)

        def _headers_are_there(self) -> None:
            if self._headers_timer is not None:
                self._headers_timer.cancel()
                self._headers_timer = None

        def _can_write(self) -> None:
            if self._write_timer is not None:
                self._write_timer.cancel()
                self._write_timer = None

    return GuardedConnection


def _not_taken(transport: asyncio.Transport) -> int:
    """Bytes that the other end has not confirmed: ours, and the kernel's, which may hold megabytes."""
    try:
        queued = fcntl.ioctl(transport.get_extra_info("socket").fileno(), termios.TIOCOUTQ, bytes(4))
    except OSError:  # where the system does not tell of sockets
        queued = bytes(4)
    return transport.get_write_buffer_size() + int.from_bytes(queued, sys.byteorder)
