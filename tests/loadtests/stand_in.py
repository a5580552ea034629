"""A small service of the same contract whose speed, limits and faults a test decides."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email import message_from_bytes
from typing import Any

import msgpack

from tests.sockets import listening

PROBLEMS = "https://looktwice.dev/problems/"


@dataclass
class StandIn:
    """An ASGI application.

    Attributes:
        service_s: that a request takes once it is its turn.
        at_once: requests that are served at the same time.
        most_waiting: requests beyond are rejected; None for no end.
        stall_every_s, stall_s: nothing is answered during the last ``stall_s`` of every such period.
        failing: every request fails.
        seen: parsed bodies of planning requests.
        waiting: requests under way now.
        began_s: on time.monotonic(); periods of stalls count from here.
    """

    service_s: float = 0.001
    at_once: int = 1000
    most_waiting: int | None = None
    stall_every_s: float = 0.0
    stall_s: float = 0.0
    failing: bool = False
    seen: list[dict[str, Any]] = field(default_factory=list)
    waiting: int = 0
    began_s: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self._turns = asyncio.Semaphore(self.at_once)

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            return
        path = scope["path"]
        if path == "/v1/models":
            card = {
                **{"name": "stand-in", "revision": "1", "engine": "none", "formats": [], "cameras": []},
                **{"image_size": [1, 1], "parameters": 0},
            }
            await _say(send, 200, {"models": [card]})
        elif path == "/metrics":
            await _say(send, 200, f"looktwice_plans_in_flight {self.waiting}\n")
        elif path.startswith("/v1/"):
            await self._plan(scope, receive, send)
        else:
            await _say(send, 200, {"status": "ready"})

    async def _plan(self, scope: Any, receive: Any, send: Any) -> None:
        content = b""
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            content += message.get("body", b"")
            if not message.get("more_body"):
                break
        headers = {name.decode(): value.decode() for name, value in scope["headers"]}
        asked = parsed(headers["content-type"], content)
        self.seen.append(asked)
        if self.failing:
            await _say(send, 500, _problem("internal", 500))
            return
        if self.most_waiting is not None and self.waiting >= self.most_waiting:
            await _say(send, 429, _problem("queue-full", 429))
            return
        self.waiting += 1
        try:
            async with self._turns:
                await asyncio.sleep(self.service_s)
            await asyncio.sleep(self._stalled_for_s())
        finally:
            self.waiting -= 1
        answer = _answer(scope["path"], asked)
        if asked.get("stream"):
            await _stream(send, answer)
        else:
            await _say(send, 200, answer)

    def _stalled_for_s(self) -> float:
        if not self.stall_s:
            return 0.0
        into = (time.monotonic() - self.began_s) % self.stall_every_s
        return self.stall_every_s - into if into > self.stall_every_s - self.stall_s else 0.0


@contextmanager
def standing_in(service: StandIn) -> Iterator[str]:
    """Its URL while the block lasts."""
    with listening(service) as (url, _):
        yield url


def parsed(media: str, content: bytes) -> dict[str, Any]:
    """A body in any of the three forms, with pictures as they were sent."""
    if media == "application/msgpack":
        found: dict[str, Any] = msgpack.unpackb(content)
        return found
    if media.startswith("multipart/form-data"):
        whole = message_from_bytes(b"Content-Type: " + media.encode() + b"\r\n\r\n" + content)
        parts: dict[str, Any] = {
            str(part.get_param("name", header="content-disposition")): part.get_payload(decode=True)
            for part in whole.walk()
            if not part.is_multipart()
        }
        asked: dict[str, Any] = json.loads(parts["request"])
        for one in asked.get("requests", [asked]):
            for clip in one["scene"]["clips"]:
                clip["images"] = [parts[image.removeprefix("cid:")] for image in clip["images"]]
        return asked
    read: dict[str, Any] = json.loads(content)
    return read


def _answer(path: str, asked: dict[str, Any]) -> dict[str, Any]:
    if path == "/v1/label":
        return {"reflection": "Ease off."}
    if path == "/v1/plan/batch":
        return {"results": [{"status": 200, "response": _answer("", one)} for one in asked["requests"]]}
    controls = asked["controls"]
    thinks = controls["thinking"] == "always"
    draw = {"thinking": "There is a car." if thinks else None}
    deadline = None if controls["deadline_ms"] is None else {"met": True, "cut": [0]}
    return {"draws": [draw] * controls["n"], "deadline": deadline}


def _problem(slug: str, status: int) -> dict[str, Any]:
    return {"type": PROBLEMS + slug, "title": slug, "status": status, "detail": slug, "request_id": "1"}


async def _say(send: Any, status: int, content: Any) -> None:
    text = content if isinstance(content, str) else json.dumps(content)
    await send({"type": "http.response.start", "status": status, "headers": []})
    await send({"type": "http.response.body", "body": text.encode()})


async def _stream(send: Any, answer: dict[str, Any]) -> None:
    headers = [(b"content-type", b"text/event-stream")]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    for event, data in (("plan", {"index": 0}), ("trajectory", {"index": 0}), ("done", answer)):
        body = f"event: {event}\ndata: {json.dumps(data)}\n\n".encode()
        await send({"type": "http.response.body", "body": body, "more_body": event != "done"})
