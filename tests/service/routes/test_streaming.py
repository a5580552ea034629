from __future__ import annotations

import json
import socket
from typing import Any

import httpx
import pytest

import looktwice.clients.wire as wire
from looktwice.model.engines.engine import EngineError
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import KEEP_ON, REASONING, SLOW_DOWN, ScriptedEngine
from tests.service.serving import Served, body

Events = list[tuple[str, Any]]


def streaming(**controls: Any) -> dict[str, Any]:
    return body(**controls) | {"stream": True}


def events_of(answer: httpx.Response) -> Events:
    assert answer.headers["content-type"].startswith("text/event-stream")
    found: Events = []
    for block in answer.text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.split("\n"))
        found.append((fields["event"], json.loads(fields["data"])))
    return found


def test_a_second_look_is_told_as_it_is_taken(served: Served) -> None:
    events = events_of(
        served.http.post("/v1/plan", json=streaming(n=1, thinking="always", deadline_ms=60_000))
    )
    assert [name for name, _ in events if name != "thinking"] == [
        "plan",
        "branch",
        "draft_trajectory",
        "revised_plan",
        "trajectory",
        "done",
    ]
    for name, data in events[:-1]:
        wire.EVENTS[name].model_validate(data)
        assert data["index"] == 0
    parts = [data["text"] for name, data in events if name == "thinking"]
    assert len(parts) > 10
    assert "".join(parts) == REASONING
    by_name = dict(events)
    assert by_name["plan"]["plan"]["text"] == str(KEEP_ON)
    assert by_name["revised_plan"]["plan"]["text"] == str(SLOW_DOWN)
    done = wire.PlanResponse.model_validate(by_name["done"])
    assert done.draws[0].trajectory == by_name["trajectory"]["trajectory"]
    assert done.draws[0].consistent is by_name["trajectory"]["consistent"] is not None
    assert done.draws[0].disagreements == by_name["trajectory"]["disagreements"]
    assert by_name["draft_trajectory"]["consistent"] is None
    assert done.draws[0].draft_trajectory == by_name["draft_trajectory"]["trajectory"]
    assert done.deadline == wire.Deadline(met=True, cut=[])


def test_the_end_is_the_answer_without_streaming(served: Served) -> None:
    plain = wire.PlanResponse.model_validate_json(served.http.post("/v1/plan", json=body(n=4)).content)
    events = events_of(served.http.post("/v1/plan", json=streaming(n=4)))
    assert wire.PlanResponse.model_validate(events[-1][1]).draws == plain.draws
    assert sorted(data["index"] for name, data in events if name == "trajectory") == [0, 1, 2, 3]


def test_reflecting_streams_too(served: Served) -> None:
    document = streaming(n=2, thinking="always") | {"plan": str(KEEP_ON)}
    events = events_of(served.http.post("/v1/reflect", json=document))
    assert wire.ReflectResponse.model_validate(events[-1][1]).draws[0].decision == "revise"


def test_what_is_not_let_in_gets_a_status(served: Served, engine: ScriptedEngine) -> None:
    problem(served.http.post("/v1/plan", json=streaming(n=0)), "invalid-controls")
    engine.failure = EngineError("broke")
    problem(served.http.post("/v1/plan", json=streaming()), "engine-failed")


def test_what_fails_on_the_way_is_an_event(served: Served, engine: ScriptedEngine) -> None:
    engine.failure_later = EngineError("broke on the way")
    events = events_of(served.http.post("/v1/plan", json=streaming()))
    assert events[-1][0] == "error"
    assert wire.Problem.model_validate(events[-1][1]).status == 503
    engine.failure_later = ZeroDivisionError("inside knowledge")
    events = events_of(served.http.post("/v1/plan", json=streaming()))
    assert events[-1][1]["type"].endswith("/internal")
    assert "inside knowledge" not in str(events)
    assert served.metric("looktwice_failures_told_total", reason="internal") == 1


@pytest.mark.parametrize(("path", "more"), [("/v1/plan", {}), ("/v1/reflect", {"plan": str(SLOW_DOWN)})])
def test_an_unknown_format_is_refused_as_without_streaming(
    served: Served, path: str, more: dict[str, Any]
) -> None:
    asked = body(n=1) | {"format": "haiku"} | more
    for streams in (False, True):
        problem(served.http.post(path, json=asked | {"stream": streams}), "unknown-format")


def test_leaving_a_stream_cancels_it(served: Served, engine: ScriptedEngine) -> None:
    served.in_loop(engine.may_finish.clear)
    content = json.dumps(streaming()).encode()
    host, port = served.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as connection:
        head = "POST /v1/plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json"
        connection.sendall(f"{head}\r\nContent-Length: {len(content)}\r\n\r\n".encode() + content)
        while b"event: plan" not in connection.recv(10_000):
            pass
        assert served.metric("looktwice_plans_in_flight") == 1
    served.until(lambda: len(engine.cancelled) == 1)
    served.until(lambda: served.metric("looktwice_plans_in_flight") == 0)


@pytest.mark.parametrize("path", ["/v1/plan", "/v1/reflect"])
def test_a_stream_cannot_be_repeated(served: Served, path: str) -> None:
    document = streaming() | ({} if path == "/v1/plan" else {"plan": str(KEEP_ON)})
    answer = served.http.post(path, json=document, headers={"Idempotency-Key": "a"})
    problem(answer, "invalid-request")
