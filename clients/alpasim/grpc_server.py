"""The egodriver as a gRPC server: bound to a port or a Unix socket, drained when it is told to end."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable

import grpc
import structlog
from carla_driver_interface.protocol import add_EgodriverServiceServicer_to_server, channel_options
from carla_driver_interface.server import UNIX_SCHEMES, bind_address

from looktwice.clients.alpasim.driver import Egodriver
from looktwice.clients.alpasim.messages import DebugFormat
from looktwice.clients.alpasim.servicer import EgodriverServicer

log = structlog.stdlib.get_logger()

CLOSING_S = 5.0
"""For calls that are under way when the server stops."""


async def start_server(
    driver: Egodriver, host: str, port: int, debug_format: DebugFormat = "json"
) -> tuple[grpc.aio.Server, str]:
    """A started server, and the address that clients dial.

    Args:
        driver: drives all sessions.
        host: an address to listen on, or a Unix socket: ``unix:///run/driver.sock``, ``unix-abstract:name``.
        port: to listen on; 0 takes a free one; unused with a Unix socket.
        debug_format: see `EgodriverServicer`.

    Raises:
        RuntimeError: nothing can listen there.
    """
    # Two servers on one port would share its calls, and each would know half of the sessions.
    server = grpc.aio.server(options=[*channel_options(), ("grpc.so_reuseport", 0)])
    servicer = EgodriverServicer(driver, debug_format)
    add_EgodriverServiceServicer_to_server(servicer, server)  # type: ignore[no-untyped-call]  # generated
    bound = server.add_insecure_port(bind_address(host, port))
    if bound == 0:
        raise RuntimeError(f"cannot listen on {bind_address(host, port)}")
    await server.start()
    return server, host if host.startswith(UNIX_SCHEMES) else bind_address(host, bound)


async def serve(
    driver: Egodriver,
    host: str,
    port: int,
    *,
    drain_s: float,
    debug_format: DebugFormat = "json",
    on_listening: Callable[[str], None],
) -> None:
    """Serve until SIGTERM or SIGINT; open sessions are then driven on for at most ``drain_s``.

    ``on_listening`` is called with the address that clients dial.
    """
    ending = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, ending.set)
    server, address = await start_server(driver, host, port, debug_format)
    on_listening(address)
    await ending.wait()
    log.info("ending", sessions=driver.sessions)
    await driver.drain(drain_s)
    await server.stop(CLOSING_S)
