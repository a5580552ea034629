"""Requests that are small to send and dear to serve: each is one that a service was once held up by."""

from __future__ import annotations

import base64
import io
import json
import struct
import zlib
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from clients.wire import MSGPACK_MEDIA_TYPE
from loadtests.call import Call
from loadtests.mix import Kind
from model.driving.scene_store import SCENE_VERSION

_JSON: Final = "application/json"
_SCANS, _CHUNKS, _MEMBERS, _MAPS, _NAME = 3000, 500_000, 1_000_000, 20_000_000, 15_000_000
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
        _call("/v1/plan", _JSON, json.dumps(document | many).encode()),
        _call("/v1/plan", _JSON, json.dumps(document | {"n" * _NAME: 0}).encode()),
        _call("/v1/plan", _JSON, json.dumps(_with_history(document)).encode()),
        _call("/v1/plan", MSGPACK_MEDIA_TYPE, b"\xdd" + struct.pack(">I", _MAPS) + b"\x80" * _MAPS),
        _call("/v1/chat/completions", _JSON, json.dumps({"messages": [_TURN] * _TURNS}).encode()),
        _call("/v1/scenes:read", "application/octet-stream", scene_file()),
    ]


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
    encoded = base64.b64encode(picture).decode()
    clips = [clip | {"images": [encoded] * len(clip["images"])} for clip in document["scene"]["clips"]]
    if name == "chunks":
        # One is enough, and more would be too large a body.
        small = base64.b64encode(chunks(0)).decode()
        clips = [clip | {"images": [small] * len(clip["images"])} for clip in clips]
        clips[0]["images"][0] = encoded
    changed = document | {"scene": document["scene"] | {"clips": clips}}
    return _call("/v1/plan", _JSON, json.dumps(changed).encode())


def _call(path: str, media_type: str, body: bytes) -> Call:
    return Call(Kind(), path, (("Content-Type", media_type),), body)
