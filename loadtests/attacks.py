"""Clients that leave, never read or dawdle, and requests that are small to send and dear to serve."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import re
import secrets
import socket
import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlsplit

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from looktwice.clients.wire import MSGPACK_MEDIA_TYPE
from looktwice.loadtests.exchange import Call
from looktwice.loadtests.mix import RequestKind
from looktwice.loadtests.sending import ServiceTarget
from looktwice.model.driving.scene_store import SCENE_VERSION

_DRIP_S: Final = 0.5
"""Between two bytes of a body that never ends, and between two looks at readiness."""
_SMALL_BUFFER: Final = 4096
_NO_LINGER: Final = struct.pack("ii", 1, 0)
"""Closing resets the connection, as a process does that dies."""


@dataclass(frozen=True)
class Hostility:
    """What is done to the service, all at once.

    Attributes:
        leaving: clients that ask for a plan, leave after ``leave_after_s``, and come back.
        never_reading: clients that ask for one and never read what comes.
        slow_bodies: clients that send a byte of their body now and then.
        costly: clients that send requests that are dear to serve, one behind the other.
        labelling: clients that have a teacher asked, one question behind the other.
        leave_after_s: time enough for the service to begin.
    """

    leaving: int = 0
    never_reading: int = 0
    slow_bodies: int = 0
    costly: int = 0
    labelling: int = 0
    leave_after_s: float = 0.05


@dataclass(frozen=True)
class Bait:
    """What hostile clients send.

    Attributes:
        plan: for those who leave, never read or dawdle.
        dear: requests that are dear to serve.
        labels: questions to a teacher.
    """

    plan: Call
    dear: Sequence[Call] = ()
    labels: Sequence[Call] = ()


RUDE: Final = Hostility(leaving=4, never_reading=8, slow_bodies=16)
COSTLY: Final = Hostility(costly=8, labelling=4)


async def be_hostile(
    target: ServiceTarget, bait: Bait, hostility: Hostility, seconds: float
) -> dict[str, dict[str, int]]:
    """Do it for so many seconds; what became of these clients, by kind and by how it ended.

    Somebody polite asks meanwhile whether the service is ready.

    ``held``: the service still held the connection at the end. ``closed``: it had closed it without a word.
    A number is the status of its answer. ``left``: the client went away itself.
    """
    call = bait.plan
    clients = {
        "leaving": [
            _leaves(target, call, hostility.leave_after_s, seconds) for _ in range(hostility.leaving)
        ],
        "never_reading": [_never_reads(target, call, seconds) for _ in range(hostility.never_reading)],
        "costly": [_asks_much(target, bait.dear, number, seconds) for number in range(hostility.costly)],
        "labelling": [_asks_much(target, bait.labels, 0, seconds) for _ in range(hostility.labelling)],
        "slow_bodies": [_sends_slowly(target, call, seconds) for _ in range(hostility.slow_bodies)],
        "ready": [_is_ready(target, seconds)],
    }
    ends = {}
    for name, ended in zip(
        clients, await asyncio.gather(*(asyncio.gather(*each) for each in clients.values())), strict=True
    ):
        ends[name] = dict(sum(ended, Counter[str]()))
    return ends


async def _is_ready(target: ServiceTarget, seconds: float) -> Counter[str]:
    ends = Counter[str]()
    clock = asyncio.get_running_loop().time
    until = clock() + seconds
    while clock() < until:
        try:
            reader, writer = await _connect(target)
            writer.write(_lines(target, "GET /readyz HTTP/1.1"))
            ends += await _ending(reader, writer, max(_DRIP_S, until - clock()))
        except OSError:
            ends["refused"] += 1
        await asyncio.sleep(_DRIP_S)
    return ends


async def _leaves(target: ServiceTarget, call: Call, after_s: float, seconds: float) -> Counter[str]:
    ends = Counter[str]()
    clock = asyncio.get_running_loop().time
    until = clock() + seconds
    while clock() < until:
        try:
            _, writer = await _connect(target)
            writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
            writer.write(_head(target, call, len(call.body)) + call.body)
            await writer.drain()
            await asyncio.sleep(after_s)
            writer.close()
            ends["left"] += 1
        except OSError:
            ends["refused"] += 1
            await asyncio.sleep(after_s)
    return ends


async def _asks_much(target: ServiceTarget, dear: Sequence[Call], first: int, seconds: float) -> Counter[str]:
    ends = Counter[str]()
    clock = asyncio.get_running_loop().time
    until, number = clock() + seconds, first
    while dear and clock() < until:
        call, number = dear[number % len(dear)], number + 1
        try:
            reader, writer = await _connect(target)
            body = never_seen(call.body)
            writer.write(_head(target, call, len(body)) + body)
            with suppress(OSError):  # it may answer before it has read all of it
                await writer.drain()
            ends += await _ending(reader, writer, max(_DRIP_S, until - clock()))
        except OSError:
            ends["refused"] += 1
            await asyncio.sleep(_DRIP_S)
    return ends


async def _never_reads(target: ServiceTarget, call: Call, seconds: float) -> Counter[str]:
    try:
        reader, writer = await _connect(target)
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SMALL_BUFFER)
    except OSError:
        return Counter({"refused": 1})
    writer.write(_head(target, call, len(call.body)) + call.body)
    await asyncio.sleep(seconds)
    return await _ending(reader, writer)


async def _sends_slowly(target: ServiceTarget, call: Call, seconds: float) -> Counter[str]:
    clock = asyncio.get_running_loop().time
    until = clock() + seconds
    try:
        reader, writer = await _connect(target)
        writer.write(_head(target, call, len(call.body)))
    except OSError:
        return Counter({"refused": 1})
    for place in range(len(call.body)):
        writer.write(call.body[place : place + 1])
        await asyncio.sleep(_DRIP_S)
        if clock() >= until or reader.at_eof() or writer.is_closing():
            break
    return await _ending(reader, writer)


async def _ending(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, timeout_s: float = _DRIP_S
) -> Counter[str]:
    try:
        line = await asyncio.wait_for(reader.readline(), timeout_s)
        said = line.split()
        end = said[1].decode() if len(said) > 1 and said[1].isdigit() else "closed"
    except TimeoutError:
        end = "held"
    except OSError:
        end = "closed"
    writer.close()
    return Counter({end: 1})


async def _connect(target: ServiceTarget) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    where = urlsplit(target.url)
    secure = where.scheme == "https"
    # Beyond twice the limit, what is not read stays in the way of the service.
    return await asyncio.open_connection(
        where.hostname, where.port or (443 if secure else 80), ssl=secure or None, limit=_SMALL_BUFFER
    )


def _head(target: ServiceTarget, call: Call, length: int) -> bytes:
    headers = (("Content-Length", str(length)), *call.headers)
    return _lines(target, f"POST {call.path} HTTP/1.1", headers)


def _lines(target: ServiceTarget, first: str, headers: Sequence[tuple[str, str]] = ()) -> bytes:
    named = (("Host", urlsplit(target.url).netloc), *headers, *target.headers.items())
    lines = [first, *(f"{name}: {value}" for name, value in named)]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


_JSON: Final = "application/json"
_MARK: Final = b"LOOKTWICE"
"""Nine bytes behind the end of a picture, where no decoder reads: three bytes are four characters."""
_CODED_MARK: Final = re.compile(base64.b64encode(_MARK))
_SCANS, _CHUNKS, _MEMBERS, _MAPS, _NAME = 3000, 500_000, 1_000_000, 20_000_000, 15_000_000
_SCANS_TAKEN: Final = 20
"""Beside the ten that an encoder writes: as many as a service takes."""
_TURN: Final = {"role": "user", "content": [0] * 3900}
_TURNS: Final = 62
"""Of a chat: less than 1 MB, so that they are read on the loop."""
_SIDE: Final = 2000
"""Pixels: as many as a service takes."""


def costly_calls(polite: Call) -> list[Call]:
    """Requests in which one thing is dear to read; the rest is of ``polite``, a call in JSON for one scene.

    They ask for one draw: that many draws are much to plan, is for admission and rates to bound.
    """
    document = json.loads(polite.body)
    document["controls"] = {"n": 1}
    many = {f"unknown-{number}": 0 for number in range(_MEMBERS)}
    return [
        _with_pictures("scans", document, scans(_SCANS)),
        _with_pictures("chunks", document, chunks(_CHUNKS)),
        _with_pictures("large", document, large()),
        _with_pictures("scans that are taken", document, scans(_SCANS_TAKEN)),
        _call("/v1/plan", _JSON, json.dumps(document | many).encode()),
        _call("/v1/plan", _JSON, json.dumps(document | {"n" * _NAME: 0}).encode()),
        _call("/v1/plan", _JSON, json.dumps(_with_history(document)).encode()),
        _call("/v1/plan", MSGPACK_MEDIA_TYPE, b"\xdd" + struct.pack(">I", _MAPS) + b"\x80" * _MAPS),
        _call("/v1/chat/completions", _JSON, json.dumps({"messages": [_TURN] * _TURNS}).encode()),
        _call("/v1/scenes:read", "application/octet-stream", scene_file()),
    ]


def never_seen(body: bytes) -> bytes:
    """A body of `costly_calls` with other bytes behind its pictures, so that none is remembered."""
    return _CODED_MARK.sub(lambda _: base64.b64encode(secrets.token_bytes(len(_MARK))), body)


def scans(count: int) -> bytes:
    """A progressive JPEG of some kB whose last scan comes so many times more."""
    buffer = io.BytesIO()
    Image.new("RGB", (_SIDE, _SIDE)).save(buffer, "JPEG", progressive=True)
    encoded = buffer.getvalue()
    begins = encoded.rfind(b"\xff\xda")
    return encoded[:-2] + encoded[begins:-2] * count + encoded[-2:]


def chunks(count: int) -> bytes:
    """A PNG with so many empty chunks."""
    buffer = io.BytesIO()
    Image.new("RGB", (64, 64)).save(buffer, "PNG")
    encoded = buffer.getvalue()
    empty = struct.pack(">I", 0) + b"teSt" + struct.pack(">I", zlib.crc32(b"teSt"))
    return encoded[:33] + empty * count + encoded[33:]


def large() -> bytes:
    """A picture as large as is taken, and as slow to decode as one of its size can be."""
    shades = np.random.default_rng(0).integers(0, 256, (_SIDE // 8, _SIDE // 8, 3), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(shades).resize((_SIDE, _SIDE)).save(buffer, "WEBP", quality=80, method=0)
    return buffer.getvalue()


def scene_file() -> bytes:
    """A Parquet file of some kB that would unpack to gigabytes."""
    clips = pa.list_(pa.struct([("camera", pa.string()), ("images", pa.list_(pa.binary()))]))
    table = pa.table(
        {
            "scene_id": pa.array(["a"]),
            "clips": pa.array([[{"camera": "front_wide_120", "images": [bytes(8000)] * 200_000}]], clips),
        }
    ).replace_schema_metadata({b"looktwice.scene_version": SCENE_VERSION.encode()})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _with_history(document: Any) -> Any:
    scene = document["scene"] | {"history": [["a", "b", "c", "d"]] * 20_000}
    return document | {"scene": scene}


def _with_pictures(name: str, document: Any, picture: bytes) -> Call:
    encoded = base64.b64encode(picture + bytes(-len(picture) % 3) + _MARK).decode()
    clips = [clip | {"images": [encoded] * len(clip["images"])} for clip in document["scene"]["clips"]]
    if name == "chunks":
        # One is enough, and more would be too large a body.
        small = base64.b64encode(chunks(0)).decode()
        clips = [clip | {"images": [small] * len(clip["images"])} for clip in clips]
        clips[0]["images"][0] = encoded
    changed = document | {"scene": document["scene"] | {"clips": clips}}
    return _call("/v1/plan", _JSON, json.dumps(changed).encode())


def _call(path: str, media_type: str, body: bytes) -> Call:
    return Call(RequestKind(), path, (("Content-Type", media_type),), body)
