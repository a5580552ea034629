"""The same request, asked again: its answer is given again, not made again."""

from __future__ import annotations

import asyncio
import hashlib
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Final

from starlette.responses import Response

from service.problems import IDEMPOTENCY_KEY_REUSED, ProblemError

REPLAYED_HEADER: Final = "Idempotency-Replayed"
_KEPT: Final = 1024


@dataclass(frozen=True)
class _Made:
    fingerprint: bytes
    until_s: float
    answer: asyncio.Task[Response]


class Idempotency:
    """Answers by the idempotency keys they were asked for with, in memory and for a while.

    A caller that asks again while the answer is being made waits for it, and the work goes on when its first
    caller leaves: whoever lost a connection comes back for what was made meanwhile. Failures are not kept.

    Args:
        kept_s: how long an answer is kept.
        clock: seconds, ever growing.
    """

    def __init__(self, kept_s: float, clock: Callable[[], float]) -> None:
        self._kept_s, self._clock = kept_s, clock
        self._made: OrderedDict[tuple[str, str], _Made] = OrderedDict()

    async def once(
        self, owner: str, key: str, asked: bytes, work: Callable[[], Awaitable[Response]]
    ) -> Response:
        """The answer that ``work`` makes, or made for the same key before.

        Args:
            owner: whose key of the service it is; keys of different owners never meet.
            key: of this request.
            asked: path and body; the same key with others is a mistake of the caller's.
            work: makes the answer.

        Raises:
            ProblemError: the key came with another request before; or whatever ``work`` raises.
        """
        self._forget_old()
        place, fingerprint = (owner, key), hashlib.sha256(asked).digest()
        made = self._made.get(place)
        if made is not None and made.fingerprint != fingerprint:
            raise ProblemError(IDEMPOTENCY_KEY_REUSED, "use a new key for another request")
        if made is not None:
            answer = await asyncio.shield(made.answer)
            return Response(
                answer.body, answer.status_code, {REPLAYED_HEADER: "true"}, media_type=answer.media_type
            )
        task = asyncio.ensure_future(_ensure_coroutine(work))
        self._made[place] = _Made(fingerprint, self._clock() + self._kept_s, task)
        try:
            return await asyncio.shield(task)
        finally:
            task.add_done_callback(lambda done: self._keep_only_success(place, done))

    def _keep_only_success(self, place: tuple[str, str], done: asyncio.Task[Response]) -> None:
        if done.cancelled() or done.exception() is not None:
            self._made.pop(place, None)

    def _forget_old(self) -> None:
        now_s = self._clock()
        while self._made:
            oldest = next(iter(self._made.values()))
            if oldest.until_s > now_s and len(self._made) < _KEPT:
                return
            self._made.popitem(last=False)


async def _ensure_coroutine(work: Callable[[], Awaitable[Response]]) -> Response:
    return await work()
