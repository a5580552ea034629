from __future__ import annotations

import threading

import httpx
import pytest

from model.engines.engine import EngineError
from service.settings import Settings
from tests.service.scripted_engine import KEEP_ON, ScriptedEngine
from tests.service.serving import Served, body, serve
from tests.service.test_errors import problem

KEY = {"Idempotency-Key": "frame-17"}


def test_the_same_answer_is_given_again(served: Served, engine: ScriptedEngine) -> None:
    first = served.http.post("/v1/plan", json=body(), headers=KEY)
    again = served.http.post("/v1/plan", json=body(), headers=KEY)
    assert again.content == first.content
    assert again.headers["content-type"] == first.headers["content-type"]
    assert again.headers["Idempotency-Replayed"] == "true"
    assert "Idempotency-Replayed" not in first.headers
    assert len(engine.submitted) == 1
    served.http.post("/v1/plan", json=body(), headers={"Idempotency-Key": "frame-18"})
    assert len(engine.submitted) == 2


def test_another_request_with_the_key_is_a_mistake(served: Served) -> None:
    served.http.post("/v1/plan", json=body(), headers=KEY)
    problem(served.http.post("/v1/plan", json=body(n=3), headers=KEY), "idempotency-key-reused")
    document = body() | {"plan": str(KEEP_ON)}
    problem(served.http.post("/v1/reflect", json=document, headers=KEY), "idempotency-key-reused")


def test_failures_are_not_kept(served: Served, engine: ScriptedEngine) -> None:
    engine.failure = EngineError("broke")
    problem(served.http.post("/v1/plan", json=body(), headers=KEY), "engine-failed")
    engine.failure = None
    assert served.http.post("/v1/plan", json=body(), headers=KEY).status_code == 200


def test_who_asks_meanwhile_waits_for_the_same(served: Served, engine: ScriptedEngine) -> None:
    served.in_loop(engine.may_finish.clear)
    answers: list[httpx.Response] = []

    def ask() -> None:
        answers.append(httpx.post(served.url + "/v1/plan", json=body(), headers=KEY, timeout=30))

    threads = [threading.Thread(target=ask) for _ in range(3)]
    for thread in threads:
        thread.start()
    served.until(lambda: len(engine.submitted) == 1)
    served.in_loop(engine.may_finish.set)
    for thread in threads:
        thread.join()
    assert len(engine.submitted) == 1
    assert len({answer.content for answer in answers}) == 1


def test_the_answer_is_made_for_who_comes_back(served: Served, engine: ScriptedEngine) -> None:
    served.in_loop(engine.may_finish.clear)
    with pytest.raises(httpx.ReadTimeout):
        httpx.post(served.url + "/v1/plan", json=body(), headers=KEY, timeout=0.5)
    assert engine.cancelled == []
    served.in_loop(engine.may_finish.set)
    answer = served.http.post("/v1/plan", json=body(), headers=KEY)
    assert answer.status_code == 200
    assert len(engine.submitted) == 1


def test_answers_are_kept_for_a_while_only(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(idempotency_s=0.05)) as served:
        for _ in range(2):
            served.http.post("/v1/plan", json=body(), headers=KEY)
            threading.Event().wait(0.2)
    assert len(engine.submitted) == 2
