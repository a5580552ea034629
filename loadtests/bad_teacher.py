"""A teacher that means no good: an endpoint of OpenAI's dialect whose answers are dear to read."""

from __future__ import annotations

import asyncio
import json
import re
import threading
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import aclosing, contextmanager, suppress
from typing import Final

_LONG_BYTES: Final = 100_000_000
_PIECE: Final = b" " * 65_536
_DRIP_S: Final = 1.0
_HEAD: Final = "HTTP/1.1 {status}\r\nContent-Type: application/json\r\nConnection: close\r\n{more}\r\n"
_START_WITHIN_S: Final = 10.0
_UNPAID: Final = {
    "choices": [{"message": {"content": "Ease off."}}],
    "usage": {"prompt_tokens": -5, "completion_tokens": -(10**400)},
}


async def _long() -> AsyncGenerator[bytes]:
    yield _HEAD.format(status="200 OK", more=f"Content-Length: {_LONG_BYTES}\r\n").encode()
    for _ in range(_LONG_BYTES // len(_PIECE)):
        yield _PIECE


async def _dripping() -> AsyncGenerator[bytes]:
    yield _HEAD.format(status="200 OK", more=f"Content-Length: {_LONG_BYTES}\r\n").encode()
    while True:
        yield b" "
        await asyncio.sleep(_DRIP_S)


async def _at_once() -> AsyncGenerator[bytes]:
    yield _HEAD.format(status="503 Busy", more="Retry-After: -5\r\nContent-Length: 0\r\n").encode()


async def _unpaid() -> AsyncGenerator[bytes]:
    content = json.dumps(_UNPAID).encode()
    yield _HEAD.format(status="200 OK", more=f"Content-Length: {len(content)}\r\n").encode() + content


_WAYS: Final[dict[str, Callable[[], AsyncGenerator[bytes]]]] = {
    "100 MB": _long,
    "a byte a second": _dripping,
    "Retry-After: -5": _at_once,
    "negative counts": _unpaid,
}


class BadTeacher:
    """Answers in one of its ways after the other.

    Attributes:
        url: up to and without ``/chat/completions``.
        asked: how often it answered in which way, or began to.
    """

    def __init__(self) -> None:
        self.url, self.asked = "", Counter[str]()

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection: one answer, whatever the question is."""
        try:
            # An asker who has had enough closes the connection.
            with suppress(OSError, asyncio.IncompleteReadError):
                head = await reader.readuntil(b"\r\n\r\n")
                length = re.search(rb"content-length: *([0-9]+)", head.lower())
                await reader.readexactly(int(length[1]) if length else 0)
                way = list(_WAYS)[self.asked.total() % len(_WAYS)]
                self.asked[way] += 1
                async with aclosing(_WAYS[way]()) as parts:
                    async for part in parts:
                        writer.write(part)
                        await writer.drain()
        finally:
            writer.close()


@contextmanager
def bad_teacher() -> Iterator[BadTeacher]:
    """It listens on a free port of this machine, in a thread of its own, until the block ends."""
    teacher, begun = BadTeacher(), threading.Event()
    loop = asyncio.new_event_loop()

    async def listen() -> None:
        server = await asyncio.start_server(teacher.answer, "127.0.0.1", 0)
        teacher.url = f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v1"
        begun.set()
        async with server:
            await server.serve_forever()

    def run() -> None:
        with suppress(asyncio.CancelledError):
            loop.run_until_complete(listening)

    listening = loop.create_task(listen())
    thread = threading.Thread(target=run, name="bad teacher")
    thread.start()
    if not begun.wait(_START_WITHIN_S):
        raise RuntimeError("the teacher does not listen")
    try:
        yield teacher
    finally:
        loop.call_soon_threadsafe(lambda: [task.cancel() for task in asyncio.all_tasks(loop)])
        thread.join()
        loop.close()
