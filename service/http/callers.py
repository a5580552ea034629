"""Work for callers who may leave before it is done."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from typing import Final, TypeVar

from starlette.requests import Request

CALLER_LEFT_STATUS: Final = 499
"""Nobody reads it; logs and metrics show it."""

_Done = TypeVar("_Done")


class CallerLeft(Exception):
    """The caller closed the connection before the answer was ready."""


async def while_connected(request: Request, work: Awaitable[_Done]) -> _Done:
    """What ``work`` comes to; raises `CallerLeft`, and ends it, once nobody waits for it."""

    async def caller_leaves() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    working, leaving = asyncio.ensure_future(work), asyncio.ensure_future(caller_leaves())
    try:
        await asyncio.wait((working, leaving), return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        raise CallerLeft
    finally:
        working.cancel()
        leaving.cancel()
        await asyncio.gather(working, leaving, return_exceptions=True)
