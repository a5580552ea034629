"""What a body may hold, before anybody asks what it means."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import httpx
import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from looktwice.clients.wire import MSGPACK_MEDIA_TYPE, Problem
from looktwice.service.http.documents import MAX_MEMBERS, MAX_OBJECTS, MAX_VALUES, read_json, read_msgpack
from looktwice.service.problems import ProblemError
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body

JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | st.text(),
    lambda values: st.lists(values) | st.dictionaries(st.text(max_size=20), values),
)


@given(JSON_VALUES)
def test_values_are_read_as_they_were_written(value: Any) -> None:
    assert read_json(json.dumps(value).encode()) == value
    assert read_msgpack(msgpack.packb(value)) == value


MANY = {
    "unknown members": {f"key-{number}": 1 for number in range(MAX_MEMBERS + 1)},
    "numbers": [[0.0] * 5000] * 51,
    "empty objects": [[{}] * 5000] * 3,
    "a long name": {"k" * 201: 1},
}
READERS: list[tuple[Callable[[bytes], Any], Callable[[Any], bytes]]] = [
    (read_json, lambda value: json.dumps(value).encode()),
    (read_msgpack, msgpack.packb),
]


@pytest.mark.parametrize("reader", READERS, ids=["json", "msgpack"])
@pytest.mark.parametrize("name", MANY)
def test_too_much_is_refused(
    name: str, reader: tuple[Callable[[bytes], Any], Callable[[Any], bytes]]
) -> None:
    read, write = reader
    with pytest.raises(ProblemError, match=r"at most .* are accepted|exceeds max_map_len") as caught:
        read(write(MANY[name]))
    assert caught.value.kind.slug in ("body-too-large", "invalid-body")
    assert len(caught.value.detail) < 200


def test_the_largest_legitimate_bodies_are_far_from_the_bounds() -> None:
    one = body()
    track = {"x_m": 1.0, "y_m": 1.0, "heading_rad": 0.0, "speed_ms": 1.0, "length_m": 4.0, "width_m": 2.0}
    one["scene"]["tracks"] = [track | {"kind": "vehicle", "lights": ["brake"]}] * 16
    written = json.dumps({"requests": [one] * 64})
    assert sum(map(written.count, ",[{")) < MAX_VALUES / 4
    assert written.count("{") < MAX_OBJECTS / 4
    assert len(read_json(written.encode())["requests"]) == 64


@pytest.mark.parametrize("content_type", ["application/json", MSGPACK_MEDIA_TYPE])
def test_a_body_of_a_million_faults_is_answered_with_a_short_one(
    served: Served, engine: ScriptedEngine, content_type: str
) -> None:
    document = body()
    document |= {f"unknown-{number}": 0 for number in range(1_000_000)}
    content = json.dumps(document).encode() if "json" in content_type else msgpack.packb(document)
    answer = served.http.post("/v1/plan", content=content, headers={"Content-Type": content_type})
    found = problem(answer, "body-too-large" if "json" in content_type else "invalid-body")
    assert len(answer.content) < 2000
    assert len(found.errors) <= 20
    assert engine.submitted == []


def test_what_a_caller_wrote_is_quoted_in_part_only(served: Served) -> None:
    document = body()
    document["scene"]["x" * 150] = 1
    document["controls"]["y" * 150] = 1
    answer = served.http.post("/v1/plan", json=document)
    assert len(answer.content) < 3000
    document = body()
    document["scene"]["z" * 20_000_000] = 1
    answer = served.http.post("/v1/plan", json=document)
    problem(answer, "body-too-large")
    assert len(answer.content) < 1000


def test_bad_points_are_counted_once_there_are_too_many(served: Served) -> None:
    document = body()
    document["scene"]["history"] = [["a", "b", "c", "d"]] * 20_000
    answer = served.http.post("/v1/plan", json=document)
    found = problem(answer, "invalid-history")
    assert len(found.errors) <= 20
    assert len(answer.content) < 20_000


POINTS: list[list[Any]] = [[["a", "b"]] * 400] * 90
"""Of which each is wrong twice."""
ROWS: list[list[str]] = [["a", "b", "c"]] * 50
TURNS: list[dict[str, Any]] = [{"role": "user", "content": [0] * 3900}] * 62


@pytest.mark.parametrize(
    ("path", "field", "wrong"),
    [
        ("/v1/label", "annotations", {"agents": [], "lane_lines": POINTS}),
        ("/v1/label", "annotations", {"agents": [{"poses": ROWS}] * 400, "lane_lines": []}),
        ("/v1/score", "labels", {"lanes": [{"ring": ring} for ring in POINTS]}),
        ("/v1/score", "labels", {"intersections": POINTS}),
        ("/v1/score", "labels", {"drivable": [POINTS[:10]] * 9}),
        ("/v1/score", "labels", {"red_lights": [{"ring": ring} for ring in POINTS]}),
        ("/v1/score", "labels", {"centreline": [point for ring in POINTS[:5] for point in ring]}),
        ("/v1/feedback", "labels", {"agents": [{"poses": ROWS}] * 300}),
        ("/v1/feedback", "trajectories", [[["a", "b", "c"]] * 64] * 60),
        ("/v1/chat/completions", "messages", TURNS),
    ],
)
def test_of_a_hundred_thousand_bad_points_few_are_made_faults(
    served: Served, path: str, field: str, wrong: object
) -> None:
    answer = served.http.post(path, json={field: wrong})
    assert answer.status_code == (400 if path.startswith("/v1/chat/") else 422)
    found = Problem.model_validate_json(answer.content)
    assert found.errors
    more = re.search(r"and ([0-9]+) more", found.detail)
    assert more is None or int(more[1]) < 400


def test_an_operators_body_is_read_as_carefully(served: Served) -> None:
    answer: httpx.Response = served.http.post(
        "/v1/models:load", json={f"unknown-{number}": 0 for number in range(500)}
    )
    problem(answer, "body-too-large")
