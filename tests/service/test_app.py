from __future__ import annotations

import json

import pytest

from looktwice.model.engines.engine import EngineError
from looktwice.service.operations.settings import Settings
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body, serve


def test_models(served: Served) -> None:
    (card,) = served.http.get("/v1/models").json()["models"]
    assert (card["name"], card["revision"], card["engine"]) == ("scripted", "r1", "scripted")
    assert card["cameras"] == ["front_wide_120", "front_tele_30"]
    assert card["image_size"] == [224, 128]


def test_not_ready_until_warm(engine: ScriptedEngine, settings: Settings) -> None:
    engine.may_start.clear()
    with serve(engine, settings, wait=False) as served:
        assert served.http.get("/healthz").json() == {"status": "alive"}
        for answer in (
            served.http.get("/readyz"),
            served.http.get("/v1/models"),
            served.http.post("/v1/plan", json=body()),
        ):
            problem(answer, "not-ready")
            assert answer.headers["Retry-After"] == "1"
        assert served.metric("looktwice_ready") == 0
        served.in_loop(engine.may_start.set)
        served.until_ready()
        assert served.http.get("/readyz").json() == {"status": "ready"}
        assert served.metric("looktwice_ready") == 1
        assert served.metric("looktwice_model_info", name="scripted", revision="r1") == 1
    assert engine.submitted == []
    assert engine.stopped


def test_an_engine_that_cannot_start_is_told_to_both_probes(
    engine: ScriptedEngine, settings: Settings
) -> None:
    engine.start_failure = EngineError("no weights")
    with serve(engine, settings, wait=False) as served:
        served.until(lambda: "the log has why" in served.http.get("/readyz").text)
        served.until(lambda: served.http.get("/healthz").status_code == 503)
        assert "the log has why" in problem(served.http.get("/healthz"), "engine-failed").detail
        problem(served.http.post("/v1/plan", json=body()), "engine-failed")


def test_stopping_does_not_wait_for_a_start_that_hangs(engine: ScriptedEngine, settings: Settings) -> None:
    engine.may_start.clear()
    with serve(engine, settings, wait=False):
        pass
    assert engine.stopped


def test_request_ids_are_taken_over_or_made(served: Served) -> None:
    given = served.http.get("/healthz", headers={"X-Request-ID": "Car-7:000.1_a"})
    assert given.headers["X-Request-ID"] == "Car-7:000.1_a"
    made = {served.http.get("/healthz").headers["X-Request-ID"] for _ in range(5)}
    assert len(made) == 5


@pytest.mark.parametrize("strange", ["", "a b", "<script>", "x" * 129, 'a"b'])
def test_strange_request_ids_are_replaced(served: Served, strange: str) -> None:
    answer = served.http.get("/nowhere", headers={"X-Request-ID": strange})
    assert answer.headers["X-Request-ID"] not in ("", strange)
    problem(answer, "not-found")


def test_requests_are_logged_once_and_probes_not(served: Served, capfd: pytest.CaptureFixture[str]) -> None:
    served.http.get("/healthz")
    served.http.post("/v1/plan", json=body(), headers={"X-Request-ID": "one"})
    served.until(lambda: served.metric("looktwice_requests_total", endpoint="/v1/plan") == 1)
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    requests = [line for line in lines if line["event"] == "request"]
    assert [(line["path"], line["status"], line["request_id"]) for line in requests] == [
        ("/v1/plan", 200, "one")
    ]


def test_other_pages_may_not_ask_unless_named(engine: ScriptedEngine) -> None:
    asked = {"Origin": "https://dash.example", "Access-Control-Request-Method": "POST"}
    with serve(engine, Settings()) as served:
        answer = served.http.options("/v1/plan", headers=asked)
        assert "Access-Control-Allow-Origin" not in answer.headers
        assert answer.status_code == 405
    with serve(ScriptedEngine(), Settings(cors_origins=("https://dash.example",))) as served:
        answer = served.http.options("/v1/plan", headers=asked)
        assert answer.headers["Access-Control-Allow-Origin"] == "https://dash.example"
        stranger = served.http.options("/v1/plan", headers=asked | {"Origin": "https://evil.example"})
        assert "Access-Control-Allow-Origin" not in stranger.headers
