from __future__ import annotations

import json
import threading
from typing import Any

import httpx
import pytest

import looktwice.clients.wire as wire
from looktwice.model.engines.engine import EngineError
from looktwice.service.operations.settings import Settings
from looktwice.service.planning.events import Arrival
from looktwice.service.planning.submitting import SceneSubmitter
from tests.service.http.test_problem_documents import BOMB, problem
from tests.service.scenes import scene
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body


@pytest.fixture
def settings() -> Settings:
    return Settings(max_draws=8)


def ask(served: Served, *requests: Any) -> list[wire.BatchResult]:
    answer = served.http.post("/v1/plan/batch", json={"requests": list(requests)})
    assert answer.status_code == 200, answer.text
    return wire.BatchResponse.model_validate_json(answer.content).results


def test_a_batch_is_answered_as_its_requests_would_be(served: Served, engine: ScriptedEngine) -> None:
    requests = [body(scene(f"{number}"), n=2, seed=number) for number in range(10)]
    results = ask(served, *requests)
    assert {request.scene.scene_id for request in engine.submitted} == {f"{k}" for k in range(10)}
    for asked, result in zip(requests, results, strict=True):
        alone = served.http.post("/v1/plan", json=asked)
        assert result.status == 200
        assert result.response is not None
        assert result.response.draws == wire.PlanResponse.model_validate_json(alone.content).draws


def test_one_that_fails_leaves_the_others(served: Served) -> None:
    broken = body()
    broken["scene"]["clips"][0]["images"][0] = BOMB
    results = ask(served, body(n=1), broken, body(n=9), body(n=1) | {"format": "haiku"})
    assert [result.status for result in results] == [200, 422, 200, 422]
    assert results[1].problem is not None
    assert results[1].problem.type.endswith("invalid-image")
    assert results[3].problem is not None
    assert results[3].problem.type.endswith("unknown-format")


@pytest.mark.parametrize(
    "broken",
    [
        {},
        7,
        body(n=0),
        body() | {"colour": "red"},
        body() | {"scene": body()["scene"] | {"history": [[0.0, 0.0, 0.0]] * 3}},
    ],
    ids=["no scene", "no request", "no draws", "unknown", "short history"],
)
def test_one_that_breaks_the_contract_fails_alone_and_as_it_would_alone(served: Served, broken: Any) -> None:
    good, bad = ask(served, body(n=1), broken)
    assert good.status == 200
    alone = served.http.post("/v1/plan", json=broken)
    assert bad.problem is not None
    assert bad.status == alone.status_code == 422
    told = wire.Problem.model_validate_json(alone.content)
    assert bad.problem.type == told.type
    assert [fault.pointer for fault in bad.problem.errors] == [fault.pointer for fault in told.errors]


@pytest.mark.parametrize(
    ("requests", "slug", "pointer"),
    [
        ([], "invalid-request", "/requests"),
        ([body()] * 65, "invalid-request", "/requests"),
        ([body() | {"stream": True}], "invalid-controls", "/requests/0/stream"),
    ],
    ids=["none", "too many", "a stream"],
)
def test_bad_batches(served: Served, engine: ScriptedEngine, requests: Any, slug: str, pointer: str) -> None:
    found = problem(served.http.post("/v1/plan/batch", json={"requests": requests}), slug)
    assert found.errors[0].pointer == pointer
    assert engine.submitted == []


def test_a_batch_waits_where_a_scene_would_be_refused(served: Served, engine: ScriptedEngine) -> None:
    served.in_loop(engine.may_finish.clear)
    answers: dict[str, httpx.Response] = {}  # they end together, in any order

    def post(path: str, document: Any) -> threading.Thread:
        def ask() -> None:
            answers[path] = httpx.post(served.url + path, json=document, timeout=30)

        thread = threading.Thread(target=ask)
        thread.start()
        return thread

    alone = post("/v1/plan", body(n=8))
    served.until(lambda: len(engine.submitted) == 1)
    problem(served.http.post("/v1/plan", json=body(n=1)), "queue-full")
    batch = post("/v1/plan/batch", {"requests": [body(n=4), body(n=4), body(n=4)]})
    served.until(lambda: served.metric("looktwice_queue_draws") == 12)
    assert len(engine.submitted) == 1
    served.in_loop(engine.may_finish.set)
    for thread in (alone, batch):
        thread.join()
    assert [answer.status_code for answer in answers.values()] == [200, 200]
    results = answers["/v1/plan/batch"].json()["results"]
    assert [result["status"] for result in results] == [200] * 3
    assert all(result["response"]["timing"]["queue_ms"] > 0 for result in results)
    assert served.metric("looktwice_queue_draws") == 0


def test_scenes_that_fail_are_counted(served: Served, engine: ScriptedEngine) -> None:
    engine.failure = EngineError("broke")
    results = ask(served, body(n=1), body(n=1))
    assert [result.status for result in results] == [503, 503]
    assert served.metric("looktwice_rejections_total", reason="engine-failed") == 2
    assert served.metric("looktwice_failures_told_total") == 0, "a 503 is a refusal"


def test_a_defect_in_one_scene_leaves_the_others_and_is_counted(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_turn = SceneSubmitter.in_turn

    async def unlucky(planning: SceneSubmitter, asked: wire.PlanRequest, arrival: Arrival) -> Any:
        if asked.scene.scene_id == "unlucky":
            raise ArithmeticError("no")
        return await in_turn(planning, asked, arrival)

    monkeypatch.setattr(SceneSubmitter, "in_turn", unlucky)
    results = ask(served, body(scene("lucky")), body(scene("unlucky")))
    assert [result.status for result in results] == [200, 500]
    assert results[1].problem is not None
    assert results[1].problem.type.endswith("internal")
    assert served.metric("looktwice_failures_told_total", reason="internal") == 1


@pytest.mark.parametrize("seed", [2**127, "\ud800"])
def test_with_a_key_a_scene_that_cannot_be_packed_fails_alone_too(served: Served, seed: Any) -> None:
    broken = body(n=1) | {"controls": {"n": 1, "seed": seed}}
    content = json.dumps({"requests": [body(n=1), broken]})
    headers = {"Idempotency-Key": "unpackable", "Content-Type": "application/json"}
    for _ in range(2):
        answer = served.http.post("/v1/plan/batch", content=content, headers=headers)
        assert [result["status"] for result in answer.json()["results"]] == [200, 422]


def test_with_a_key_only_what_is_final_is_kept(served: Served, engine: ScriptedEngine) -> None:
    headers, document = {"Idempotency-Key": "batch"}, {"requests": [body(n=1), body() | {"format": "haiku"}]}

    def again() -> list[int]:
        answer = served.http.post("/v1/plan/batch", json=document, headers=headers)
        return [result["status"] for result in answer.json()["results"]]

    engine.failure = EngineError("broke")
    assert again() == [503, 422]
    engine.failure = None
    asked = len(engine.submitted)
    assert again() == [200, 422]
    assert len(engine.submitted) > asked
    asked = len(engine.submitted)
    assert again() == [200, 422]
    assert len(engine.submitted) == asked, "the same answer again"
