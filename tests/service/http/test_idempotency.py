from __future__ import annotations

import asyncio
import threading

import httpx
import pytest
from starlette.responses import Response

from looktwice.model.engines.engine import EngineError
from looktwice.service.http.idempotency import Idempotency
from looktwice.service.operations.settings import Settings
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import KEEP_ON, ScriptedEngine
from tests.service.serving import Served, body, serve

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


def test_an_answer_is_given_again_by_a_service_that_is_full(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(max_draws=2, rate_limit="4/minute")) as served:
        first = served.http.post("/v1/plan", json=body(n=2), headers=KEY)
        served.in_loop(engine.may_finish.clear)
        thread = threading.Thread(
            target=lambda: httpx.post(served.url + "/v1/plan", json=body(n=2), timeout=30)
        )
        thread.start()
        served.until(lambda: len(engine.submitted) == 2)
        problem(served.http.post("/v1/plan", json=body()), "queue-full")
        for _ in range(5):  # more than the limit allows: nothing is planned for
            assert served.http.post("/v1/plan", json=body(n=2), headers=KEY).content == first.content
        served.in_loop(engine.may_finish.set)
        thread.join()


def test_large_answers_go_early_and_those_being_made_stay() -> None:
    async def test() -> None:
        may_finish, made = asyncio.Event(), list[str]()
        idempotency = Idempotency(600.0, lambda: 0.0)

        async def ask(key: str, size: int) -> Response:
            async def work() -> Response:
                made.append(key)
                if not size:
                    await may_finish.wait()
                return Response(b"x" * size)

            return await idempotency.once("car", key, b"", work)

        waiting = asyncio.create_task(ask("first", 0))
        await asyncio.sleep(0)
        for number in range(7):
            await ask(f"{number}", 15_000_000)
        assert not idempotency.knows("car", "0")
        assert idempotency.knows("car", "6")
        again = asyncio.create_task(ask("first", 0))
        await asyncio.sleep(0)
        may_finish.set()
        await asyncio.gather(waiting, again)
        assert made.count("first") == 1

    asyncio.run(test())
