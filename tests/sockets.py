"""ASGI applications behind real sockets."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import uvicorn

PATIENCE_S = 120


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


@contextmanager
def listening(
    app: Any, port: int = 0, server: uvicorn.Server | None = None
) -> Iterator[tuple[str, asyncio.AbstractEventLoop]]:
    """The application's URL and event loop, until the block ends; behind ``server`` where one is given."""
    listener = socket.create_server(("127.0.0.1", port))
    if server is None:
        config = uvicorn.Config(app, log_config=None, ws="none", timeout_graceful_shutdown=5)
        server = uvicorn.Server(config)
    loops: list[asyncio.AbstractEventLoop] = []
    begun = threading.Event()

    async def run() -> None:
        loops.append(asyncio.get_running_loop())
        begun.set()
        await server.serve([listener])

    thread = threading.Thread(target=lambda: asyncio.run(run()), name="server")
    thread.start()
    assert begun.wait(PATIENCE_S)
    try:
        # The socket listens already, so a first request waits for the server and is not refused.
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", loops[0]
    finally:
        server.should_exit = True
        thread.join(PATIENCE_S)
        listener.close()
    assert not thread.is_alive()
