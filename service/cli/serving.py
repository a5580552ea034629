"""A service of a command's own, for as long as the command needs it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

import httpx

START_WITHIN_S: Final = 300.0
_PIPE_BYTES: Final = 4096
"""Of a log that nobody reads: some ten lines."""


@contextmanager
def served(
    options: Sequence[str], settings: Mapping[str, str], *, unread_log: bool = False
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """`looktwice serve` on a free port, ready; its process and its URL, until the block ends.

    Args:
        options: of the command.
        settings: environment variables that differ from this process' own.
        unread_log: its log goes to a pipe that nobody empties.

    Raises:
        RuntimeError: it did not become ready.
    """
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-m", "looktwice.service.cli", "serve", "--port", str(port), *options],
        env=os.environ | settings,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE if unread_log else None,
        pipesize=_PIPE_BYTES if unread_log else -1,
    )
    url = f"http://127.0.0.1:{port}"
    try:
        _wait_for(url, process)
        yield process, url
    finally:
        process.terminate()
        process.wait()


def _wait_for(url: str, process: subprocess.Popen[bytes]) -> None:
    until_s = time.monotonic() + START_WITHIN_S
    while time.monotonic() < until_s:
        if process.poll() is not None:
            raise RuntimeError(f"the service ended with code {process.returncode}")
        try:
            if httpx.get(f"{url}/readyz", trust_env=False).status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.5)
    raise RuntimeError(f"the service was not ready within {START_WITHIN_S:g} s")
