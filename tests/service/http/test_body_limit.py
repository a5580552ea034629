from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import httpx
import pytest

from looktwice.service.operations.settings import Settings
from tests.service.http.test_problem_documents import JSON, problem
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body, serve


def chunks(total: int) -> Iterator[bytes]:
    for _ in range(total // 1_000_000):
        yield b" " * 1_000_000


def test_50_mb_announced(served: Served, engine: ScriptedEngine) -> None:
    answer = served.http.post("/v1/plan", content=b" " * 50_000_000, headers=JSON)
    assert "24000000" in problem(answer, "body-too-large").detail
    assert engine.submitted == []
    assert served.metric("looktwice_requests_total", endpoint="/v1/plan", status="413") == 1


def test_50_mb_unannounced(served: Served, engine: ScriptedEngine) -> None:
    problem(served.http.post("/v1/plan", content=chunks(50_000_000), headers=JSON), "body-too-large")
    assert engine.submitted == []


def test_a_lie_about_the_length_ends_the_answer_not_the_server(served: Served) -> None:
    answer = served.http.post("/v1/plan", content=b"{}", headers=JSON | {"Content-Length": "2"})
    assert answer.status_code == 422
    assert served.http.get("/healthz").status_code == 200


def test_who_asks_first_is_answered_before_sending(served: Served) -> None:
    host, port = served.url.removeprefix("http://").split(":")
    head = (
        "POST /v1/plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        "Content-Length: 50000000\r\nExpect: 100-continue\r\n\r\n"
    )
    with socket.create_connection((host, int(port)), timeout=30) as connection:
        connection.sendall(head.encode())
        assert connection.recv(100).startswith(b"HTTP/1.1 413")


@pytest.fixture
def settings() -> Settings:
    return Settings(max_scene_file_bytes=1000)


def test_large_bodies_below_the_limit_are_served(served: Served) -> None:
    padded = json.dumps(body()) + " " * 20_000_000
    assert served.http.post("/v1/plan", content=padded, headers=JSON).status_code == 200


def test_scene_files_have_a_limit_of_their_own(served: Served) -> None:
    problem(served.http.post("/v1/scenes:read", content=b"x" * 1001), "body-too-large")
    problem(served.http.post("/v1/scenes:read", content=b"x" * 1000), "invalid-scene-file")


@contextmanager
def held(served: Served, sent: int, padded: str) -> Iterator[httpx.Response]:
    """While ``sent`` bytes of a body are held that never ends: how another, which is too much, is refused.

    Of two bodies that arrive at once either may be the one that is too much, so both are sent until it is
    the second.
    """
    host, port = served.url.removeprefix("http://").split(":")
    head = f"POST /v1/plan HTTP/1.1\r\nHost: localhost\r\nContent-Length: {sent + 1}\r\n\r\n"
    answers: list[httpx.Response] = []
    with ExitStack() as stack:

        def second_is_refused() -> bool:
            stack.close()
            connection = stack.enter_context(socket.create_connection((host, int(port)), timeout=30))
            connection.sendall(head.encode() + b" " * sent)
            answers.append(served.http.post("/v1/plan", content=padded, headers=JSON))
            return answers[-1].status_code == 429

        served.until(second_is_refused)
        yield answers[-1]


def test_all_bodies_together_have_a_limit(engine: ScriptedEngine) -> None:
    padded = json.dumps(body()) + " " * 1_000_000
    with serve(engine, Settings(max_held_bytes=1_500_000, body_timeout_s=300)) as served:
        with held(served, 1_000_000, padded) as refused:
            assert "together" in problem(refused, "queue-full").detail
            assert refused.headers["Retry-After"] == "1"
            assert served.http.post("/v1/plan", json=body()).status_code == 200
        served.until(lambda: served.http.post("/v1/plan", content=padded, headers=JSON).status_code == 200)


def test_large_bodies_leave_room_for_small_ones(engine: ScriptedEngine) -> None:
    """The large ones that are under way hold a quarter, and those that are refused nothing."""
    settings = Settings(max_held_bytes=16_000_000, max_body_bytes=3_000_000, body_timeout_s=300)
    padded = json.dumps(body()) + " " * 2_000_000
    with serve(engine, settings) as served:
        with held(served, 2_500_000, padded) as refused:
            for _ in range(9):
                assert "4000000 bytes" in problem(refused, "queue-full").detail
                refused = served.http.post("/v1/plan", content=padded, headers=JSON)
            assert served.http.post("/v1/plan", json=body()).status_code == 200
        served.until(lambda: served.http.post("/v1/plan", content=padded, headers=JSON).status_code == 200)


def test_large_bodies_are_read_no_faster_than_their_pace(engine: ScriptedEngine) -> None:
    """One that comes behind others is not there in time; small ones are read whatever large ones take."""
    settings = Settings(max_body_bytes=2_000_000, large_bytes_per_s=10, body_timeout_s=2)
    padded = (json.dumps(body()) + " " * 1_500_000).encode()
    head = f"POST /v1/plan HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(padded)}\r\n\r\n"
    with serve(engine, settings) as served:
        assert served.http.post("/v1/plan", content=padded, headers=JSON).status_code == 200
        host, port = served.url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=30) as connection:
            connection.sendall(head.encode() + padded)
            assert served.http.post("/v1/plan", json=body()).status_code == 200
            served.until(
                lambda: served.metric("looktwice_requests_total", endpoint="/v1/plan", status="408") == 1
            )
