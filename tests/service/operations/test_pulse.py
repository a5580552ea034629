"""Readiness tells when nobody was answered, and when requests or pictures wait."""

from __future__ import annotations

import http.client
import json
import threading
import time
from typing import Any

import httpx
import pytest

from looktwice.model.engines.engine import EngineLoad
from looktwice.service.http.documents import read_json
from looktwice.service.operations.settings import Settings
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import body, serve


class WaitingEngine(ScriptedEngine):
    """Whose pictures have waited for so long."""

    pictures_wait_s = 0.0

    @property
    def load(self) -> EngineLoad:
        return EngineLoad(rows=64, rows_used=0, pictures_wait_s=self.pictures_wait_s)


def test_a_loop_that_stood_still_is_not_ready_for_a_while(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(stall_s=0.5)) as served:
        served.in_loop(lambda: time.sleep(1.0))
        served.until(lambda: served.http.get("/readyz").status_code == 503)
        assert "nobody was answered" in problem(served.http.get("/readyz"), "not-ready").detail
        assert served.http.get("/healthz").status_code == 200
        served.until_ready()


def test_a_probe_that_waited_through_a_stall_hears_of_it(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(stall_s=0.5)) as served:
        probe = http.client.HTTPConnection("127.0.0.1", int(served.url.rsplit(":", 1)[1]), timeout=30)
        probe.request("GET", "/readyz")
        assert probe.getresponse().read()  # connected, so that only the next request waits
        stalled, go_on = threading.Event(), threading.Event()

        def stall() -> None:
            stalled.set()
            go_on.wait(30)

        served.loop.call_soon_threadsafe(stall)
        assert stalled.wait(30)
        probe.request("GET", "/readyz")
        time.sleep(1.0)
        go_on.set()
        answer = probe.getresponse()
        assert "nobody was answered" in json.loads(answer.read())["detail"]
        assert answer.status == 503
        probe.close()


def test_threads_that_stand_still_make_it_not_ready(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(stall_s=0.5)) as served:
        go_on = threading.Event()
        more_than_there_are = 64
        served.in_loop(
            lambda: [served.loop.run_in_executor(None, go_on.wait, 30) for _ in range(more_than_there_are)]
        )
        # On a busy machine the loop itself may stand still for a moment, which is told first.
        served.until(lambda: "to be checked" in served.http.get("/readyz").json().get("detail", ""))
        problem(served.http.get("/readyz"), "not-ready")
        go_on.set()
        served.until_ready()


def test_a_large_body_that_is_read_without_end_makes_it_not_ready(
    engine: ScriptedEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def slow(content: bytes) -> Any:
        assert go_on.wait(30)
        return read_json(content)

    monkeypatch.setattr("looktwice.service.http.payloads.read_json", slow)
    large = json.dumps(body() | {"x": "y" * 2_000_000}).encode()
    answers: list[int] = []
    with serve(engine, Settings(stall_s=0.5)) as served:

        def ask() -> None:
            headers = {"Content-Type": "application/json"}
            answer = httpx.post(served.url + "/v1/plan", content=large, headers=headers, timeout=30)
            answers.append(answer.status_code)

        asking = threading.Thread(target=ask)
        asking.start()
        served.until(lambda: served.http.get("/readyz").status_code == 503)
        assert "large body" in problem(served.http.get("/readyz"), "not-ready").detail
        go_on.set()
        asking.join()
        served.until_ready()
    assert answers == [422]


def test_pictures_that_wait_make_it_not_ready() -> None:
    engine = WaitingEngine()
    with serve(engine, Settings(stall_s=30.0)) as served:
        engine.pictures_wait_s = 31.0
        assert "pictures have waited" in problem(served.http.get("/readyz"), "not-ready").detail
        engine.pictures_wait_s = 0.0
        assert served.http.get("/readyz").status_code == 200
