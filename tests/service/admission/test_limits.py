"""What is full, too slow or broken is said, and leaves nothing behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
import pytest

from looktwice.model.engines.engine import EngineError
from looktwice.service.operations.settings import Settings
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body, serve


@pytest.fixture
def settings() -> Settings:
    return Settings(max_draws=6, max_scenes=2, queue_timeout_s=0.3, decode_timeout_s=0.3)


@contextmanager
def waiting(served: Served, n: int) -> Iterator[list[httpx.Response]]:
    """A request of ``n`` draws that stays under way until the block ends; its answer is in the list then."""
    answers: list[httpx.Response] = []

    def ask() -> None:
        answers.append(httpx.post(served.url + "/v1/plan", json=body(n=n), timeout=30))

    before = len(served.engine.submitted)
    thread = threading.Thread(target=ask)
    thread.start()
    served.until(lambda: len(served.engine.submitted) > before)
    try:
        yield answers
    finally:
        served.in_loop(served.engine.may_begin.set)
        served.in_loop(served.engine.may_finish.set)
        thread.join()


def test_beyond_capacity_is_refused_before_the_engine_hears_of_it(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(max_draws=6)) as served:
        served.in_loop(engine.may_finish.clear)
        with waiting(served, 4) as answers:
            refused = served.http.post("/v1/plan", json=body(n=3))
            assert "2 are free" in problem(refused, "queue-full").detail
            assert int(refused.headers["Retry-After"]) >= 1
            assert len(engine.submitted) == 1
            assert served.metric("looktwice_rejections_total", reason="queue-full") == 1
            assert served.metric("looktwice_capacity_draws") == 6
        assert answers[0].status_code == 200
        assert served.http.post("/v1/plan", json=body(n=6)).status_code == 200


def test_when_full_a_body_is_not_even_looked_at(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(max_draws=4)) as served:
        served.in_loop(engine.may_finish.clear)
        with waiting(served, 4):
            headers = {"Content-Type": "application/json"}
            problem(
                served.http.post("/v1/plan", content=b"{ no JSON" * 100_000, headers=headers), "queue-full"
            )


def test_alone_a_scene_may_be_larger(engine: ScriptedEngine, settings: Settings) -> None:
    with serve(engine, settings) as served:
        assert served.http.post("/v1/plan", json=body(n=60)).status_code == 200


def test_waiting_and_decoding_have_limits_of_their_own(engine: ScriptedEngine, settings: Settings) -> None:
    with serve(engine, settings) as served:
        served.in_loop(engine.may_begin.clear)
        with waiting(served, 2) as answers:
            served.until(lambda: len(answers) == 1)
            problem(answers[0], "queue-timeout")
            assert int(answers[0].headers["Retry-After"]) >= 1
        served.in_loop(engine.may_finish.clear)
        with waiting(served, 2) as answers:
            served.until(lambda: len(answers) == 1)
            problem(answers[0], "decode-timeout")
        assert len(engine.cancelled) == 2
        assert served.http.post("/v1/plan", json=body(n=6)).status_code == 200


def test_the_queue_is_seen(engine: ScriptedEngine) -> None:
    with serve(engine, Settings()) as served:
        served.in_loop(engine.may_begin.clear)
        with waiting(served, 5):
            assert served.metric("looktwice_queue_scenes") == 1
            assert served.metric("looktwice_queue_draws") == 5
        assert served.metric("looktwice_queue_draws") == 0
        assert served.metric("looktwice_queue_seconds_count") == 1
        assert served.metric("looktwice_kv_rows") == 64
        served.until(lambda: served.metric("looktwice_kv_rows_used") == 0)


def test_deadlines_are_answered_for(served: Served) -> None:
    generous = served.http.post("/v1/plan", json=body(n=2, deadline_ms=60_000)).json()
    assert generous["deadline"] == {"met": True, "cut": []}
    tight = served.http.post("/v1/plan", json=body(n=2, deadline_ms=1)).json()
    assert tight["deadline"]["met"] is False
    assert served.http.post("/v1/plan", json=body(n=2)).json()["deadline"] is None
    assert served.metric("looktwice_deadlines_total", outcome="met") == 1
    assert served.metric("looktwice_deadlines_total", outcome="missed") == 1


def test_passes_and_forced_tokens_are_counted(served: Served) -> None:
    served.http.post("/v1/plan", json=body(n=3, thinking="never"))
    assert served.metric("looktwice_response_passes_sum") == 90
    assert served.metric("looktwice_response_tokens_total", choice="free") == 60
    assert served.metric("looktwice_response_tokens_total", choice="forced") == 3 * (49 - 20)


def test_a_broken_engine_is_started_again(engine: ScriptedEngine) -> None:
    with serve(engine, Settings()) as served:
        served.in_loop(engine.may_start.clear)
        served.in_loop(lambda: engine.breaks.put_nowait(EngineError("out of memory")))
        served.until(lambda: served.http.get("/readyz").status_code == 503)
        assert "the log has why" in problem(served.http.post("/v1/plan", json=body()), "engine-failed").detail
        assert served.http.get("/healthz").status_code == 200
        served.in_loop(engine.may_start.set)
        served.until_ready()
        assert served.http.post("/v1/plan", json=body()).status_code == 200
        assert served.metric("looktwice_engine_restarts_total") == 1
        assert engine.starts == 2


def test_given_up_is_a_missed_deadline(engine: ScriptedEngine, settings: Settings) -> None:
    with serve(engine, settings) as served:
        served.in_loop(engine.may_finish.clear)
        problem(served.http.post("/v1/plan", json=body(n=2, deadline_ms=100)), "decode-timeout")
        assert served.metric("looktwice_deadlines_total", outcome="missed") == 1
        document = body(n=2) | {"stream": True}
        streamed = served.http.post("/v1/plan", json=document)
        assert "decode-timeout" in streamed.text
        assert served.metric("looktwice_rejections_total", reason="decode-timeout") == 2


def test_who_is_refused_has_spent_nothing(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(max_draws=6, rate_limit="10/minute")) as served:
        served.in_loop(engine.may_finish.clear)
        with waiting(served, 4):
            for _ in range(4):
                problem(served.http.post("/v1/plan", json=body(n=6)), "queue-full")
        assert served.http.post("/v1/plan", json=body(n=6)).status_code == 200
        problem(served.http.post("/v1/plan", json=body(n=1)), "rate-limited")
