"""What goes wrong around the service stays there: cancelled streams, full disks, clocks that jump."""

from __future__ import annotations

import asyncio
import json
import os
import time
from pathlib import Path

import httpx
import pytest

from looktwice.service.operations.settings import Settings
from tests.service.http.test_server import process
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body, serve

STREAMS = int(os.environ.get("LOOKTWICE_TEST_STREAMS", "300"))
"""10,000 take some minutes."""
AT_ONCE = 20


def test_streams_that_are_left_leave_nothing_behind(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(max_draws=4 * AT_ONCE)) as served:
        served.in_loop(engine.may_finish.clear)
        host, port = served.url.removeprefix("http://").split(":")
        content = json.dumps(body(n=2) | {"stream": True}).encode()
        head = f"POST /v1/plan HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(content)}\r\n"
        asked = f"{head}Content-Type: application/json\r\n\r\n".encode() + content

        async def leave() -> None:
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(asked)
            await reader.readuntil(b"event: plan")
            writer.transport.abort()

        async def all_of_them() -> None:
            free = asyncio.Semaphore(AT_ONCE)

            async def one() -> None:
                async with free:
                    await leave()

            await asyncio.gather(*(one() for _ in range(STREAMS)))

        asyncio.run(all_of_them())
        served.until(lambda: len(engine.cancelled) == STREAMS)
        served.until(lambda: served.metric("looktwice_plans_in_flight") == 0)
        assert served.metric("looktwice_queue_draws") == 0
        served.in_loop(engine.may_finish.set)
        assert served.http.post("/v1/plan", json=body()).status_code == 200


def test_a_full_disk_stops_logs_and_nothing_else(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full, process(stderr=full) as (started, url):
        for seed in range(3):
            assert httpx.post(f"{url}/v1/plan", json=body(n=1, seed=seed), timeout=60).status_code == 200
        started.terminate()
        assert started.wait(60) == 0


def test_a_clock_that_jumps_changes_no_deadline(
    engine: ScriptedEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serve(engine, Settings(rate_limit="1000/minute")) as served:
        real = time.time
        for jump_s in (86_400.0, -86_400.0):
            monkeypatch.setattr(time, "time", lambda jump_s=jump_s: real() + jump_s)
            answer = served.http.post("/v1/plan", json=body(deadline_ms=60_000)).json()
            assert answer["deadline"] == {"met": True, "cut": []}
            assert answer["timing"]["total_ms"] < 60_000


def test_an_exception_in_one_request_is_that_requests_alone(served: Served, engine: ScriptedEngine) -> None:
    engine.failure = MemoryError("one batch")
    assert served.http.post("/v1/plan", json=body()).status_code == 500
    engine.failure = None
    assert served.http.post("/v1/plan", json=body()).status_code == 200
    served.until_ready()
