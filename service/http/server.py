"""The server process: listens, and on SIGTERM finishes what it has accepted before it ends."""

from __future__ import annotations

import asyncio
import ipaddress
import signal
import socket
from collections.abc import Awaitable, Callable
from types import FrameType
from typing import Final

import structlog
import uvicorn
from fastapi import FastAPI

from looktwice.service.http.auth import OPEN_PATHS
from looktwice.service.http.connection import guarded_connection
from looktwice.service.operations.settings import Settings

_LAST_WORDS_S: Final = 5
"""For answers that are made to reach their callers."""

log = structlog.stdlib.get_logger()


class Server(uvicorn.Server):
    """uvicorn's, but the first signal drains: it goes on listening, so that callers are told why not."""

    def __init__(
        self,
        config: uvicorn.Config,
        drain: Callable[[], Awaitable[None]],
        settings: Settings,
        announce: Callable[[str], None],
    ) -> None:
        super().__init__(config)
        self._drain, self._settings, self._announce = drain, settings, announce
        self._loop: asyncio.AbstractEventLoop | None = None
        self._draining: asyncio.Task[None] | None = None

    async def serve(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until drained."""
        self._loop = asyncio.get_running_loop()
        await super().serve(sockets)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and say where."""
        await super().startup(sockets)
        for server in self.servers:
            for listening in server.sockets:
                host, port, *_ = listening.getsockname()
                self._announce(f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}")

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Drain; a second signal ends at once."""
        if self._draining is not None or self._loop is None:
            self.should_exit = True
            self.force_exit = sig == signal.SIGINT
        else:
            self._loop.call_soon_threadsafe(self.drain)

    def drain(self) -> None:
        """Begin to drain, within the server's loop."""
        if self._draining is None:
            self._draining = asyncio.get_running_loop().create_task(self._finish())

    async def _finish(self) -> None:
        try:
            async with asyncio.timeout(self._settings.drain_s):
                await asyncio.gather(self._drain(), asyncio.sleep(self._settings.drain_notice_s))
        except TimeoutError:
            log.warning("drained too slowly", seconds=self._settings.drain_s)
        self.should_exit = True


def check_who_may_ask(settings: Settings, where: str) -> None:
    """Refuse to serve where others reach it, ``where``, unless there are keys or it is open on purpose.

    Raises:
        ValueError: everybody could ask.
    """
    if settings.api_keys_file is None and not settings.open:
        raise ValueError(
            f"without keys everybody who reaches {where} could use the service: set LOOKTWICE_API_KEYS_FILE "
            "(`looktwice keys new NAME`), or LOOKTWICE_OPEN=true where something before it checks who asks"
        )


def make_server(
    app: FastAPI,
    settings: Settings,
    host: str = "127.0.0.1",
    port: int = 8000,
    announce: Callable[[str], None] = lambda _: None,
) -> Server:
    """A server for an application that `create_app` made.

    Args:
        app, settings: what is served, and how.
        host, port: where to listen; port 0 takes a free one.
        announce: told the URL once it listens there.

    Raises:
        ValueError: everybody could ask from anywhere.
    """
    if not _is_loopback(host):
        check_who_may_ask(settings, host)
    config = uvicorn.Config(
        app,
        host,
        port,
        http=guarded_connection(settings.headers_timeout_s, settings.write_timeout_s, OPEN_PATHS),
        ws="none",
        log_config=None,
        access_log=False,
        limit_concurrency=settings.max_connections,
        timeout_graceful_shutdown=_LAST_WORDS_S,
        server_header=False,
    )
    return Server(config, app.state.drain, settings, announce)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
