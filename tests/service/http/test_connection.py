"""Callers that are slow, silent or greedy lose their connection; others do not notice."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator

import httpx
import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from looktwice.service.http.connection import guarded_connection
from looktwice.service.operations.settings import Settings
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body, serve
from tests.sockets import listening

HEAD = b"POST /v1/plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"


@pytest.fixture
def served(engine: ScriptedEngine) -> Iterator[Served]:
    settings = Settings(headers_timeout_s=0.4, body_timeout_s=0.4, write_timeout_s=0.4)
    with serve(engine, settings) as running:
        yield running


def connect(served: Served) -> socket.socket:
    host, port = served.url.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=30)


def ended(connection: socket.socket) -> bytes:
    """What is received until the other side ends the connection."""
    received = b""
    try:
        while part := connection.recv(65_536):
            received += part
    except ConnectionResetError:
        pass
    return received


def test_a_connection_that_says_nothing_is_closed(served: Served) -> None:
    with connect(served) as connection:
        assert ended(connection) == b""


def test_headers_that_trickle_are_not_waited_for(served: Served) -> None:
    with connect(served) as connection:
        connection.sendall(HEAD[:40])
        assert ended(connection) == b""


def test_a_length_of_thousands_of_digits_is_read(served: Served) -> None:
    with connect(served) as connection:
        connection.sendall(HEAD + b"Connection: close\r\nContent-Length: " + b"0" * 5000 + b"2\r\n\r\n{}")
        assert ended(connection).startswith(b"HTTP/1.1 422")


def test_who_leaves_while_sending_is_no_failure_of_the_service(served: Served) -> None:
    with connect(served) as connection:
        connection.sendall(HEAD + b"Content-Length: 1000\r\n\r\n{")
    served.until(lambda: served.metric("looktwice_requests_total", endpoint="/v1/plan", status="499") == 1)
    assert served.metric("looktwice_requests_total", endpoint="/v1/plan", status="500") == 0


def test_the_next_request_has_its_time_too(served: Served) -> None:
    with connect(served) as connection:
        for _ in range(2):
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
            received = b""
            while b"alive" not in received:
                received += connection.recv(10_000)
        connection.sendall(HEAD[:40])
        assert ended(connection) == b""


def test_a_body_that_trickles_gets_a_408(served: Served, engine: ScriptedEngine) -> None:
    with connect(served) as connection:
        connection.sendall(HEAD + b"Content-Length: 1000\r\n\r\n{")
        answer = ended(connection)
    assert answer.startswith(b"HTTP/1.1 408")
    assert b"body-timeout" in answer
    assert engine.submitted == []
    assert served.metric("looktwice_rejections_total", reason="body-timeout") == 1


def test_a_planning_that_takes_longer_than_its_body_is_not_cut(
    served: Served, engine: ScriptedEngine
) -> None:
    served.in_loop(engine.may_finish.clear)
    content = json.dumps(body()).encode()
    with connect(served) as connection:
        connection.sendall(HEAD + f"Content-Length: {len(content)}\r\n\r\n".encode() + content)
        connection.settimeout(1.0)
        with pytest.raises(TimeoutError):
            connection.recv(1)
        connection.settimeout(30)
        served.in_loop(engine.may_finish.set)
        assert connection.recv(100).startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize("chunk", [b"X-Pad: " + b"a" * 1000 + b"\r\n", b"X-Long: " + b"a" * 200_000])
def test_huge_headers_are_refused(served: Served, chunk: bytes) -> None:
    with connect(served) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n")
        answer = b""
        try:
            for _ in range(200):
                connection.sendall(chunk)
        except (BrokenPipeError, ConnectionResetError):
            pass
        else:
            answer = ended(connection)
    assert answer[:12] in (b"", b"HTTP/1.1 431")
    assert served.http.get("/healthz").status_code == 200


def test_who_never_reads_is_cut_off(served: Served, engine: ScriptedEngine) -> None:
    content = json.dumps(body(n=64)).encode()
    asked = HEAD + f"Content-Length: {len(content)}\r\n\r\n".encode() + content
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        host, port = served.url.removeprefix("http://").split(":")
        connection.connect((host, int(port)))
        connection.settimeout(0.1)
        # Requests one behind the other, whose answers nobody takes, until the service takes no more of them.
        with pytest.raises((TimeoutError, BrokenPipeError, ConnectionResetError)):
            connection.sendall(1000 * asked)
        connection.settimeout(30)
        served.until(lambda: _is_cut(connection))
    served.until(lambda: served.metric("looktwice_plans_in_flight") == 0)
    assert served.http.post("/v1/plan", json=body()).status_code == 200


def _is_cut(connection: socket.socket) -> bool:
    try:
        connection.send(b" ", socket.MSG_DONTWAIT)
    except (BrokenPipeError, ConnectionResetError):
        return True
    except BlockingIOError:
        pass
    return False


def test_a_body_announced_too_large_is_not_waited_for(served: Served) -> None:
    with connect(served) as connection:
        connection.sendall(HEAD + b"Content-Length: 30000000\r\n\r\n{")
        assert ended(connection).startswith(b"HTTP/1.1 413")


def test_probes_are_answered_when_no_more_connections_are(engine: ScriptedEngine) -> None:
    with serve(engine, Settings(max_connections=3)) as served:
        others = [connect(served) for _ in range(3)]
        try:
            served.until(lambda: httpx.get(f"{served.url}/v1/models").status_code == 503)
            assert httpx.get(f"{served.url}/healthz").status_code == 200
            served.until(lambda: httpx.get(f"{served.url}/readyz?verbose").status_code == 200)
        finally:
            for other in others:
                other.close()
        served.until(lambda: httpx.get(f"{served.url}/v1/models").status_code == 200)


def test_who_reads_slowly_is_not_cut_off_but_who_stops_is() -> None:
    gone = threading.Event()

    async def much(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for _ in range(100):  # uvicorn drops what is sent to a connection that was cut off
            await send({"type": "http.response.body", "body": bytes(1_000_000), "more_body": True})
        gone.set()

    connections = guarded_connection(headers_timeout_s=10.0, write_timeout_s=0.5)
    config = uvicorn.Config(much, log_config=None, ws="none", http=connections, lifespan="off")
    with listening(much, server=uvicorn.Server(config)) as (url, _), socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect(("127.0.0.1", int(url.rsplit(":", 1)[1])))
        connection.settimeout(30)
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        pause = threading.Event()
        for _ in range(30):
            connection.recv(65_536)
            pause.wait(0.1)
        assert not gone.is_set()
        assert gone.wait(30)
