"""Holds requests up while an engine takes new weights."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager


class Gate:
    """Requests go through side by side; whoever changes the weights goes alone. For one event loop."""

    def __init__(self) -> None:
        self._changing, self._nobody, self._within = asyncio.Lock(), asyncio.Event(), 0
        self._nobody.set()

    @asynccontextmanager
    async def request(self) -> AsyncGenerator[None]:
        """For a request, until it is answered; begins when no change is under way or waits."""
        async with self._changing:
            self._within += 1
            self._nobody.clear()
        try:
            yield
        finally:
            self._within -= 1
            if not self._within:
                self._nobody.set()

    @asynccontextmanager
    async def change(self) -> AsyncGenerator[None]:
        """For a change; begins when all requests before it are answered, and holds up those behind it."""
        async with self._changing:
            await self._nobody.wait()
            yield
