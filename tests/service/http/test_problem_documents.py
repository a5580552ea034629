"""Bad input gets a problem document with a stable type, and the engine never hears of it."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from looktwice.clients.wire import Problem
from looktwice.service.operations.settings import Settings
from looktwice.service.problems import KINDS, TYPE_BASE
from tests.service.scenes import scene
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body, serve

JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def engine() -> ScriptedEngine:
    return ScriptedEngine()


@pytest.fixture(scope="module")
def served(engine: ScriptedEngine, scene_file: Path) -> Iterator[Served]:
    with serve(engine, Settings(bundled_scenes=scene_file)) as running:
        yield running


def problem(answer: httpx.Response, slug: str) -> Problem:
    """The problem document, which must be of that type and complete."""
    assert answer.headers["content-type"] == "application/problem+json"
    document = Problem.model_validate_json(answer.content)
    assert document.type == TYPE_BASE + slug, document
    assert document.status == answer.status_code
    assert document.request_id == answer.headers["X-Request-ID"]
    assert document.title
    assert document.detail
    return document


def png_header(width: int, height: int) -> bytes:
    """A PNG that says how large it is and then ends."""
    content = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + content + struct.pack(">I", zlib.crc32(content))


BOMB = base64.b64encode(png_header(40_000, 40_000)).decode()
TEXT = base64.b64encode(b"hello, this is not a picture").decode()
GIF = base64.b64encode(b"GIF89a\x01\x00\x01\x00\x80\x00\x00\xff\xff\xff\x00\x00\x00").decode()


def with_(value: Any, *path: Any) -> dict[str, Any]:
    document = body()
    node: Any = document
    for part in path[:-1]:
        node = node[part]
    node[path[-1]] = value
    return document


def history(change: Any) -> dict[str, Any]:
    rows = np.asarray(body()["scene"]["history"])
    return with_(change(rows).tolist(), "scene", "history")


def swapped(rows: Any) -> Any:
    rows[[5, 6]] = rows[[6, 5]]
    return rows


def jumping(rows: Any) -> Any:
    rows[:8, 1] += 11.0
    return rows


def in_degrees(rows: Any) -> Any:
    rows[:, 3] = np.linspace(-30.0, 0.0, 16)
    return rows


ATTEMPT: dict[str, Any] = {"trajectory": [[0.0] * 4] * 64, "feedback": "Wait."}
FEEDBACK = ("invalid-attempt", "/attempt/feedback")


def without(field: str) -> dict[str, Any]:
    return {name: value for name, value in ATTEMPT.items() if name != field}


def clip(**changes: Any) -> dict[str, Any]:
    first: dict[str, Any] = body()["scene"]["clips"][0]
    return first | changes


FRAMES = body()["scene"]["clips"][0]["images"]
IMAGE = ("scene", "clips", 1, "images", 2)

BAD_BODIES: list[tuple[str, Any, str, str]] = [
    # what, body, type, pointer
    ("nothing", {}, "invalid-request", "/scene"),
    ("a list", [], "invalid-request", ""),
    ("null", None, "invalid-request", ""),
    ("history [15, 4]", history(lambda rows: rows[1:]), "invalid-history", "/scene/history"),
    ("history [16, 3]", history(lambda rows: rows[:, :3]), "invalid-history", "/scene/history/0"),
    ("history of words", with_("fast", "scene", "history"), "invalid-history", "/scene/history"),
    ("NaN", with_(float("nan"), "scene", "history", 3, 1), "invalid-history", "/scene/history/3/1"),
    ("Infinity", with_(float("inf"), "scene", "history", 3, 1), "invalid-history", "/scene/history/3/1"),
    ("not at the present", history(lambda rows: rows + 1.0), "invalid-history", "/scene/history"),
    ("newest first", history(lambda rows: rows[::-1]), "invalid-history", "/scene/history"),
    ("rows out of order", history(swapped), "invalid-history", "/scene/history/5"),
    ("a jump", history(jumping), "invalid-history", "/scene/history/8"),
    ("150 m/s", history(lambda rows: rows * 12.5), "invalid-history", "/scene/history/1"),
    ("degrees", history(in_degrees), "invalid-history", "/scene/history/1"),
    ("route [19, 2]", with_([[1.0, 0.0]] * 19, "scene", "route"), "invalid-route", "/scene/route"),
    ("route far away", with_([[1e6, 0.0]] * 20, "scene", "route"), "invalid-route", "/scene/route"),
    ("route that stands", with_([[7.0, 0.0]] * 20, "scene", "route"), "invalid-route", "/scene/route"),
    ("NaN route", with_(float("nan"), "scene", "route", 0, 0), "invalid-route", "/scene/route/0/0"),
    ("no clips", with_([], "scene", "clips"), "invalid-clip", "/scene/clips"),
    ("0 frames", with_(clip(images=[]), "scene", "clips", 0), "invalid-clip", "/scene/clips/0/images"),
    (
        "3 frames",
        with_(clip(images=FRAMES[:3]), "scene", "clips", 0),
        "invalid-clip",
        "/scene/clips/0/images",
    ),
    (
        "100 frames",
        with_(clip(images=FRAMES * 25), "scene", "clips", 0),
        "invalid-clip",
        "/scene/clips/0/images",
    ),
    (
        "a camera twice",
        with_([clip(), *body()["scene"]["clips"]], "scene", "clips"),
        "invalid-clip",
        "/scene/clips",
    ),
    (
        "unknown camera",
        with_(clip(camera="hood"), "scene", "clips", 0),
        "unknown-camera",
        "/scene/clips/0/camera",
    ),
    ("missing camera", with_([clip()], "scene", "clips"), "missing-camera", "/scene/clips"),
    ("not base64", with_("%%%", *IMAGE), "invalid-image", "/scene/clips/1/images/2"),
    ("not ASCII", with_("é", *IMAGE), "invalid-image", "/scene/clips/1/images/2"),
    ("empty picture", with_("", *IMAGE), "invalid-image", "/scene/clips/1/images/2"),
    ("not a picture", with_(TEXT, *IMAGE), "invalid-image", "/scene/clips/1/images/2"),
    ("a GIF", with_(GIF, *IMAGE), "invalid-image", "/scene/clips/1/images/2"),
    ("an image bomb", with_(BOMB, *IMAGE), "invalid-image", "/scene/clips/1/images/2"),
    ("a URL", with_("http://localhost/secret", *IMAGE), "invalid-image", "/scene/clips/1/images/2"),
    ("unknown field", with_(1, "surprise"), "unknown-field", "/surprise"),
    ("unknown field in the scene", with_(1, "scene", "speed"), "unknown-field", "/scene/speed"),
    ("unknown field in a clip", with_(1, "scene", "clips", 0, "a/b"), "unknown-field", "/scene/clips/0/a~1b"),
    ("unknown control", with_(1, "controls", "top_k"), "unknown-field", "/controls/top_k"),
    ("a field that no text can hold", with_(1, "\ud800"), "invalid-request", ""),
    ("0 draws", with_(0, "controls", "n"), "invalid-controls", "/controls/n"),
    ("a million draws", with_(10**6, "controls", "n"), "invalid-controls", "/controls/n"),
    ("a seed beyond JSON", with_(2**53, "controls", "seed"), "invalid-controls", "/controls/seed"),
    (
        "NaN temperature",
        with_(float("nan"), "controls", "temperature"),
        "invalid-controls",
        "/controls/temperature",
    ),
    (
        "threshold without adaptive",
        body(thinking="never", think_threshold=0.5),
        "invalid-controls",
        "/controls",
    ),
    ("unknown format", with_("haiku", "format"), "unknown-format", "/format"),
    ("empty plan", body(prefill=""), "invalid-plan", "/controls/prefill"),
    ("no tracks", body(prefill={}), "invalid-plan", "/controls/prefill"),
    (
        "half a meta-action",
        body(prefill={"lane": [{"word": "x"}]}),
        "invalid-plan",
        "/controls/prefill/lane/0/start_s",
    ),
    ("a list of words", body(prefill=["Wait"]), "invalid-plan", "/controls/prefill"),
    (
        "a track off the grid",
        body(prefill={"lateral": [{"start_s": 0.0, "end_s": 0.123, "word": "Straight"}]}),
        "invalid-plan",
        "/controls/prefill",
    ),
    ("an attempt that nothing refines", with_(ATTEMPT, "attempt"), "invalid-attempt", "/attempt"),
    ("an attempt without feedback", with_(without("feedback"), "attempt"), *FEEDBACK),
    ("empty feedback", with_(ATTEMPT | {"feedback": ""}, "attempt"), *FEEDBACK),
    ("endless feedback", with_(ATTEMPT | {"feedback": "x" * 4_001}, "attempt"), *FEEDBACK),
    (
        "a NaN in a draft",
        with_(ATTEMPT | {"trajectory": [[float("nan")] * 4] * 64}, "attempt"),
        "invalid-attempt",
        "/attempt/trajectory/0/0",
    ),
    (
        "a draft of another length",
        with_(ATTEMPT | {"times_s": [0.5, 1.0]}, "attempt"),
        "invalid-attempt",
        "/attempt",
    ),
    (
        "times beyond any horizon",
        body(prefill={"lateral": [{"start_s": 0.0, "end_s": 1e300, "word": "Straight"}]}),
        "invalid-plan",
        "/controls/prefill",
    ),
]


@pytest.mark.parametrize(
    ("document", "slug", "pointer"), [bad[1:] for bad in BAD_BODIES], ids=[bad[0] for bad in BAD_BODIES]
)
def test_bad_bodies(served: Served, engine: ScriptedEngine, document: Any, slug: str, pointer: str) -> None:
    # Python's writer turns NaN into the literal that JSON does not have.
    found = problem(served.http.post("/v1/plan", content=json.dumps(document), headers=JSON), slug)
    assert found.errors[0].pointer == pointer
    assert found.status == 422
    assert engine.submitted == []


def test_a_bad_plan_says_line_and_column(served: Served, engine: ScriptedEngine) -> None:
    text = "- longitudinal\n  - 0.0s-0.9s: Wait\n  - 1.2s-6.4s: Accelerate\n"
    found = problem(served.http.post("/v1/plan", json=body(prefill=text)), "invalid-plan")
    assert "line 3, column 5: gap" in found.detail
    assert engine.submitted == []


def test_every_fault_is_listed(served: Served) -> None:
    document = with_(-1.0, "controls", "temperature")
    document["scene"]["history"][2] = []
    found = problem(served.http.post("/v1/plan", json=document), "invalid-history")
    assert [fault.pointer for fault in found.errors] == ["/scene/history/2", "/controls/temperature"]
    assert "1 more" in found.detail


def test_what_was_sent_is_not_sent_back(served: Served) -> None:
    answer = served.http.post("/v1/plan", json=with_("secret" * 1000, "scene", "history"))
    assert len(answer.content) < 1000
    assert b"secret" not in answer.content


@pytest.mark.parametrize(
    "content", [b'{"scene":', b"\xff\xfe\x00", b"[" * 100_000, b"1" * 5000, b"'a'"], ids=lambda c: str(c[:9])
)
def test_not_json(served: Served, content: bytes) -> None:
    problem(served.http.post("/v1/plan", content=content, headers=JSON), "invalid-json")


def test_another_media_type(served: Served) -> None:
    content = json.dumps(body())
    problem(served.http.post("/v1/plan", content=content), "unsupported-media-type")
    answer = served.http.post("/v1/plan", content=content, headers={"Content-Type": "text/plain"})
    problem(answer, "unsupported-media-type")


def test_no_body(served: Served) -> None:
    problem(served.http.post("/v1/plan"), "invalid-request")


def test_nothing_there(served: Served) -> None:
    problem(served.http.get("/v2/plan"), "not-found")
    problem(served.http.get("/inspector/../settings.py"), "not-found")
    problem(served.http.get("/inspector/page.py"), "not-found")


def test_another_method(served: Served) -> None:
    answer = served.http.get("/v1/plan")
    assert "POST" in problem(answer, "method-not-allowed").detail
    assert answer.headers["Allow"] == "POST"


def test_types_are_stable() -> None:
    """A type is part of the contract: this list may grow, nothing in it may change."""
    assert {kind.slug: kind.status for kind in KINDS} == {
        "invalid-json": 400,
        "invalid-body": 400,
        "unauthorized": 401,
        "forbidden": 403,
        "unknown-model": 404,
        "unknown-checkpoint": 404,
        "body-timeout": 408,
        "swap-under-way": 409,
        "idempotency-key-reused": 422,
        "checkpoint-failed": 422,
        "queue-full": 429,
        "teacher-refused": 502,
        "rate-limited": 429,
        "draining": 503,
        "queue-timeout": 503,
        "decode-timeout": 504,
        "not-found": 404,
        "unknown-scene": 404,
        "method-not-allowed": 405,
        "misdirected": 421,
        "body-too-large": 413,
        "unsupported-media-type": 415,
        "invalid-request": 422,
        "unknown-field": 422,
        "invalid-clip": 422,
        "unknown-camera": 422,
        "missing-camera": 422,
        "invalid-image": 422,
        "invalid-history": 422,
        "invalid-route": 422,
        "invalid-tracks": 422,
        "invalid-controls": 422,
        "invalid-labels": 422,
        "invalid-trajectory": 422,
        "invalid-plan": 422,
        "unknown-format": 422,
        "request-refused": 422,
        "invalid-scene-file": 422,
        "invalid-attempt": 422,
        "invalid-feedback": 422,
        "cannot-imagine": 422,
        "other-plan": 422,
        "feedback-refused": 502,
        "internal": 500,
        "needs-annotations": 422,
        "needs-tracks": 422,
        "nothing-in-view": 422,
        "label-refused": 502,
        "teacher-away": 503,
        "scenes-unreadable": 500,
        "not-ready": 503,
        "engine-failed": 503,
    }
    assert TYPE_BASE == "https://looktwice.dev/problems/"


def test_after_all_that_it_still_plans(served: Served, engine: ScriptedEngine) -> None:
    assert served.http.post("/v1/plan", json=body(scene("fine"))).status_code == 200
    assert [request.scene.scene_id for request in engine.submitted] == ["fine"]
    engine.submitted.clear()
