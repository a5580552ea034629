"""The same request, asked again: its answer is given again, not made again."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated, Final

from fastapi import Header, Request
from pydantic import BaseModel
from starlette.responses import Response

from looktwice.clients.wire import IDEMPOTENCY_KEY_HEADER
from looktwice.service.http.callers import while_connected
from looktwice.service.problems import IDEMPOTENCY_KEY_REUSED, INVALID_REQUEST, ProblemError

REPLAYED_HEADER: Final = "Idempotency-Replayed"
_KEPT: Final = 1024
_KEPT_BYTES: Final = 64_000_000


IdempotencyKey = Annotated[
    str | None,
    Header(
        alias=IDEMPOTENCY_KEY_HEADER,
        min_length=1,
        max_length=255,
        description="Asked again with the same key, the same request gets the answer that was made for it "
        "before; not with stream: true.",
    ),
]


class NotCached(Exception):
    """An answer that is given and not kept: another try may get a better one."""

    def __init__(self, answer: Response) -> None:
        super().__init__()
        self.answer = answer


@dataclass(frozen=True)
class _StoredAnswer:
    fingerprint: bytes
    until_s: float
    answer: asyncio.Task[Response]


class Idempotency:
    """Answers by the idempotency keys they were asked for with, in memory and for a while.

    A caller that asks again while the answer is being made waits for it, and the work goes on when its first
    caller leaves: whoever lost a connection comes back for what was made meanwhile. Failures are not kept;
    where answers are many or large, the oldest go early.

    Args:
        kept_s: how long an answer is kept.
        clock: seconds, ever growing.
    """

    def __init__(self, kept_s: float, clock: Callable[[], float]) -> None:
        self._kept_s, self._clock = kept_s, clock
        # No cachetools here: what is being made has no size yet, and must not go.
        self._made: dict[tuple[str, str], _StoredAnswer] = {}

    def knows(self, owner: str, key: str) -> bool:
        """Whether an answer was made, or is being made, for ``owner``'s ``key``."""
        self._forget_old()
        return (owner, key) in self._made

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
        self._made[place] = _StoredAnswer(fingerprint, self._clock() + self._kept_s, task)
        task.add_done_callback(lambda done: self._keep_only_success(place, done))
        return await asyncio.shield(task)

    def _keep_only_success(self, place: tuple[str, str], done: asyncio.Task[Response]) -> None:
        made = self._made.get(place)
        if made is not None and made.answer is done and not _succeeded(done):
            del self._made[place]

    def _forget_old(self) -> None:
        """Let answers go that are old, or too many; never one that is being made: it would be made twice."""
        now_s = self._clock()
        sizes = {place: _size(made) for place, made in self._made.items() if made.answer.done()}
        kept_bytes = sum(sizes.values())
        for place, size in sizes.items():
            old = self._made[place].until_s <= now_s
            if not old and len(self._made) < _KEPT and kept_bytes <= _KEPT_BYTES:
                return
            kept_bytes -= size
            del self._made[place]


def _succeeded(done: asyncio.Task[Response]) -> bool:
    return not done.cancelled() and done.exception() is None


def _size(made: _StoredAnswer) -> int:
    return len(made.answer.result().body) if _succeeded(made.answer) else 0


async def _ensure_coroutine(work: Callable[[], Awaitable[Response]]) -> Response:
    return await work()


def made_before(request: Request, idempotency: Idempotency) -> bool:
    """Whether a request's answer was made, or is being made: to give it again costs nothing."""
    key = request.headers.get(IDEMPOTENCY_KEY_HEADER)
    return key is not None and idempotency.knows(request.state.owner, key)


def refuse_key(idempotency_key: str | None) -> None:
    """Raise `ProblemError` for a stream that comes with a key."""
    if idempotency_key is not None:
        raise ProblemError(INVALID_REQUEST, f"{IDEMPOTENCY_KEY_HEADER} cannot go with stream: true")


def _content(asked: BaseModel) -> bytes:
    """What is asked, to be compared. Scenes of a batch are not checked yet, and may hold any JSON."""
    told = asked.model_dump(warnings=False)
    return json.dumps(told, default=lambda picture: base64.b64encode(picture).decode()).encode()


async def once(
    request: Request,
    idempotency: Idempotency,
    idempotency_key: str | None,
    asked: BaseModel,
    work: Callable[[], Awaitable[Response]],
) -> Response:
    """What ``work`` answers to what was ``asked``, or answered before for the same key; see `Idempotency`.

    Raises:
        CallerLeft: nobody waits for it, and it came without a key.
    """
    try:
        if idempotency_key is not None:
            same = request.url.path.encode() + _content(asked)
            return await idempotency.once(request.state.owner, idempotency_key, same, work)
        return await while_connected(request, work())
    except NotCached as given:
        return given.answer
