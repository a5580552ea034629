"""Bodies in JSON, msgpack or multipart, all of the same structure."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import msgpack
from fastapi import Request
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.datastructures import Headers, UploadFile
from starlette.exceptions import HTTPException
from starlette.responses import Response

from looktwice.clients.wire import MSGPACK_MEDIA_TYPE, MULTIPART_MEDIA_TYPE, PART_SCHEME, REQUEST_PART
from looktwice.clients.wire_values import with_pictures
from looktwice.service.http.body_limit import LARGE_BYTES
from looktwice.service.http.documents import read_json, read_msgpack
from looktwice.service.problems import INVALID_BODY, INVALID_IMAGE, INVALID_JSON, ProblemError

_JSON: Final = b"application/json"
_MAX_PARTS: Final = 2048
"""Pictures of a batch."""
_MAX_JSON_BYTES: Final = 8_000_000
"""Of the JSON part of a multipart body."""


class _Decoded(Request):
    """A request whose body was decoded; FastAPI takes it for JSON."""

    def __init__(self, request: Request, document: Any) -> None:
        headers = [each for each in request.scope["headers"] if each[0] != b"content-type"]
        scope = {**request.scope, "headers": [*headers, (b"content-type", _JSON)]}
        super().__init__(scope, request.receive)
        self._document = document

    async def body(self) -> bytes:
        return b"{}"  # FastAPI only needs to know that there is one

    async def json(self) -> Any:
        return self._document


def payload_route(check_open: Callable[[Request], None]) -> type[APIRoute]:
    """A kind of route that takes all of them; the schema of each is that of the JSON body.

    Args:
        check_open: raises `ProblemError` where nothing can be accepted; asked before a body is decoded.
    """

    class PayloadRoute(APIRoute):
        def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
            handle = super().get_route_handler()

            async def decoded(request: Request) -> Response:
                try:
                    check_open(request)
                except ProblemError:
                    # Read, or a caller that is still sending would miss the answer.
                    async for _ in request.stream():
                        pass
                    raise
                media_type = media_type_of(request.headers)
                if media_type == MSGPACK_MEDIA_TYPE:
                    request = _Decoded(request, await _read(read_msgpack, await _whole(request)))
                elif media_type == MULTIPART_MEDIA_TYPE:
                    request = _Decoded(request, await _multipart(request))
                elif _is_json(media_type):
                    body = await _whole(request)
                    request = _Decoded(request, await _read(read_json, body) if body else None)
                return await handle(request)

            return decoded

    return PayloadRoute


def media_type_of(headers: Headers) -> str:
    """The media type of a body, without parameters."""
    return headers.get("content-type", "").partition(";")[0].strip().lower()


def _is_json(media_type: str) -> bool:
    main, _, kind = media_type.partition("/")
    return main == "application" and (kind == "json" or kind.endswith("+json"))


class _LargeBodies:
    """Reads large bodies beside the answers of others: several at once would leave planning no processor."""

    def __init__(self) -> None:
        self._one_at_a_time = ThreadPoolExecutor(1, "looktwice-bodies")
        self._since_s: float | None = None

    @property
    def reading_s(self) -> float:
        """How long the one that is being read has been; those behind it wait their turn."""
        since_s = self._since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    async def read(self, read: Callable[[bytes], Any], body: bytes) -> Any:
        """What ``read`` makes of ``body``."""
        return await asyncio.get_running_loop().run_in_executor(self._one_at_a_time, self._run, read, body)

    def _run(self, read: Callable[[bytes], Any], body: bytes) -> Any:
        self._since_s = time.monotonic()
        try:
            return read(body)
        finally:
            self._since_s = None


LARGE_BODIES: Final = _LargeBodies()


async def _read(read: Callable[[bytes], Any], body: bytes) -> Any:
    return read(body) if len(body) <= LARGE_BYTES else await LARGE_BODIES.read(read, body)


async def _whole(request: Request) -> bytes:
    """The body, which the request does not keep: it is decoded, and may be large."""
    return b"".join([part async for part in request.stream()])


async def _multipart(request: Request) -> Any:
    try:
        form = await request.form(max_files=_MAX_PARTS, max_fields=8, max_part_size=_MAX_JSON_BYTES)
    except HTTPException as error:  # Starlette's own for what it cannot read
        if error.status_code != 400:
            raise
        raise ProblemError(INVALID_BODY, f"not multipart: {error.detail}") from None
    try:
        asked = form.get(REQUEST_PART)
        if asked is None:
            raise ProblemError(INVALID_BODY, f"the multipart body lacks the part {REQUEST_PART!r}")
        text = await asked.read() if isinstance(asked, UploadFile) else asked
        parts = {name: await part.read() for name, part in form.items() if isinstance(part, UploadFile)}
    finally:
        await form.close()
    document = await _read(read_json, text.encode() if isinstance(text, str) else text)
    try:
        return with_pictures(document, lambda picture: _part(picture, parts))
    except RecursionError:
        raise ProblemError(INVALID_JSON, f"part {REQUEST_PART!r} is nested too deeply") from None


def _part(image: Any, parts: dict[str, bytes]) -> Any:
    if not isinstance(image, str) or not image.startswith(PART_SCHEME):
        return image
    name = image.removeprefix(PART_SCHEME)
    if name not in parts:
        raise ProblemError(INVALID_IMAGE, f"the body has no file part {name!r}")
    return parts[name]


def respond(request: Request, answer: BaseModel) -> Response:
    """An answer in msgpack where the caller accepts it, else in JSON."""
    if MSGPACK_MEDIA_TYPE in request.headers.get("accept", ""):
        return Response(msgpack.packb(answer.model_dump()), media_type=MSGPACK_MEDIA_TYPE)
    return Response(answer.model_dump_json(), media_type="application/json")
