from __future__ import annotations

import base64
import json
import threading
from typing import Any

import msgpack
import pytest

from looktwice.clients.wire import MSGPACK_MEDIA_TYPE, PlanResponse
from looktwice.service.http import payloads
from looktwice.service.http.body_limit import LARGE_BYTES
from tests.service.http.test_problem_documents import problem
from tests.service.scenes import scene
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body

PACKED = {"Content-Type": MSGPACK_MEDIA_TYPE}


def with_bytes() -> dict[str, Any]:
    document = body(n=1)
    for clip in document["scene"]["clips"]:
        clip["images"] = [base64.b64decode(image) for image in clip["images"]]
    return document


def parts() -> tuple[dict[str, Any], dict[str, bytes]]:
    document, files = with_bytes(), {}
    for clip in document["scene"]["clips"]:
        for number, image in enumerate(clip["images"]):
            name = f"{clip['camera']}-{number}"
            files[name] = image
            clip["images"][number] = f"cid:{name}"
    return document, files


def test_all_three_mean_the_same(served: Served, engine: ScriptedEngine) -> None:
    document, files = parts()
    answers = [
        served.http.post("/v1/plan", json=body(n=1)),
        served.http.post("/v1/plan", content=msgpack.packb(with_bytes()), headers=PACKED),
        served.http.post(
            "/v1/plan", files={"request": (None, json.dumps(document), "application/json"), **files}
        ),
        served.http.post("/v1/plan", data={"request": json.dumps(document)}, files=files),
    ]
    draws = [PlanResponse.model_validate_json(answer.content).draws for answer in answers]
    assert draws[0] == draws[1] == draws[2] == draws[3]
    for request in engine.submitted:
        assert request.scene.clips == scene().clips
        assert request.scene.history.tolist() == scene().history.tolist()


def test_answers_come_packed_where_they_are_accepted(served: Served) -> None:
    answer = served.http.post("/v1/plan", json=body(n=1), headers={"Accept": MSGPACK_MEDIA_TYPE})
    assert answer.headers["content-type"] == MSGPACK_MEDIA_TYPE
    unpacked = PlanResponse.model_validate(msgpack.unpackb(answer.content))
    plain = PlanResponse.model_validate_json(served.http.post("/v1/plan", json=body(n=1)).content)
    assert unpacked.draws == plain.draws


@pytest.mark.parametrize(
    "content",
    [
        b"\xc1",
        b"\x93\x01",
        b"\x81\xa1a\x01\x00",
        b"\x91" * 5000,
        msgpack.packb({"a": msgpack.ExtType(5, b"x")}),
        msgpack.packb({1: 2}),
    ],
    ids=["reserved", "short", "long", "deep", "extension", "keys that are no text"],
)
def test_not_msgpack(served: Served, engine: ScriptedEngine, content: bytes) -> None:
    problem(served.http.post("/v1/plan", content=content, headers=PACKED), "invalid-body")
    assert engine.submitted == []


def test_faults_are_placed_as_in_json(served: Served) -> None:
    document = with_bytes()
    document["scene"]["clips"][1]["images"][2] = b"no picture"
    found = problem(
        served.http.post("/v1/plan", content=msgpack.packb(document), headers=PACKED), "invalid-image"
    )
    assert found.errors[0].pointer == "/scene/clips/1/images/2"
    document["scene"]["clips"][1]["images"][2] = 7
    found = problem(
        served.http.post("/v1/plan", content=msgpack.packb(document), headers=PACKED), "invalid-clip"
    )
    assert found.errors[0].pointer == "/scene/clips/1/images/2"


@pytest.mark.parametrize(
    ("data", "slug"),
    [
        ({"other": "{}"}, "invalid-body"),
        ({"request": "{"}, "invalid-json"),
        ({"request": "[" * 50_000 + "]" * 50_000}, "invalid-json"),
        ({"request": "[" * 90_000}, "invalid-json"),
        ({"request": "{}"}, "invalid-request"),
        ({"request": json.dumps(parts()[0])}, "invalid-image"),
    ],
)
def test_bad_parts(served: Served, engine: ScriptedEngine, data: dict[str, str], slug: str) -> None:
    problem(served.http.post("/v1/plan", data=data, files={"unused": b"x"}), slug)
    assert engine.submitted == []


@pytest.mark.parametrize("depth", [200, 900])
@pytest.mark.parametrize("key", ["scene", "unknown"])
def test_nested_deeply(served: Served, engine: ScriptedEngine, depth: int, key: str) -> None:
    text = f'{{"{key}": {"[" * depth}{"]" * depth}}}'
    packed = b"\x81" + msgpack.packb(key) + b"\x91" * depth + b"\xc0"
    for content, media_type in ((text, "application/json"), (packed, "application/msgpack")):
        answer = served.http.post("/v1/plan", content=content, headers={"Content-Type": media_type})
        assert answer.status_code == 422, answer.text
    assert engine.submitted == []


def test_not_multipart(served: Served) -> None:
    for boundary in ("", "; boundary=x"):
        headers = {"Content-Type": f"multipart/form-data{boundary}"}
        problem(served.http.post("/v1/plan", content=b"--y\r\n", headers=headers), "invalid-body")


@pytest.mark.parametrize("size", [LARGE_BYTES - 1000, LARGE_BYTES + 1000])
@pytest.mark.parametrize("name", ["read_json", "read_msgpack"])
def test_large_bodies_are_read_beside_the_loop(
    served: Served, monkeypatch: pytest.MonkeyPatch, size: int, name: str
) -> None:
    read = getattr(payloads, name)
    threads: list[str] = []

    def watched(content: bytes) -> Any:
        threads.append(threading.current_thread().name)
        return read(content)

    monkeypatch.setattr(payloads, name, watched)
    document = {"x": "y" * size}
    headers = PACKED if name == "read_msgpack" else {"Content-Type": "application/json"}
    content = msgpack.packb(document) if name == "read_msgpack" else json.dumps(document).encode()
    assert served.http.post("/v1/plan", content=content, headers=headers).status_code == 422
    assert [each.startswith("looktwice-bodies") for each in threads] == [size > LARGE_BYTES]
