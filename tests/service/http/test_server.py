"""The server as a process: signals, keys, what it listens on."""

from __future__ import annotations

import asyncio
import base64
import itertools
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import httpx
import pytest

from looktwice.clients.labelling.checks import FailedCheck
from looktwice.clients.labelling.teachers.teacher import Answer, Question
from looktwice.loadtests.attacks import costly_calls, never_seen, scans
from looktwice.loadtests.bodies import make_call
from looktwice.loadtests.mix import RequestKind
from looktwice.model.bundled import CHECKPOINT
from looktwice.model.driving.images import decode_image
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.service.app import create_app
from looktwice.service.http.server import check_who_may_ask, make_server
from looktwice.service.operations.keys import new_line
from looktwice.service.operations.settings import Settings
from tests.checkpoints import noisy_scene
from tests.model.driving.drives import labelled_scene
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import KEEP_ON, REASONING, SLOW_DOWN, ScriptedEngine
from tests.service.serving import Served, body, serve
from tests.sockets import free_port, listening
from tests.waiting import until

WAIT_S = 120
PATIENT = {"LOOKTWICE_QUEUE_TIMEOUT_S": "600", "LOOKTWICE_DECODE_TIMEOUT_S": "600"}
"""However busy the machine, requests wait for its processors."""


class SlowTeacher:
    """A teacher that answers when it may."""

    name, revision = "slow", "1"

    def __init__(self) -> None:
        self.asked, self.may_answer = 0, asyncio.Event()

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        self.asked += 1
        await self.may_answer.wait()
        return Answer(REASONING)

    async def close(self) -> None:
        pass


@contextmanager
def process(
    stderr: int | IO[str] = subprocess.PIPE, **settings: str
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`looktwice serve` with the bundled checkpoint, ready; ``settings`` by their variables' names."""
    port = free_port()
    started = subprocess.Popen(
        [sys.executable, "-m", "looktwice.service.cli", "serve", "--port", str(port)],
        env=os.environ | {"LOOKTWICE_DRAIN_NOTICE_S": "3", "LOOKTWICE_MAX_DRAWS": "24"} | settings,
        stderr=stderr,
        text=True,
    )
    url = f"http://127.0.0.1:{port}"
    try:
        pause = threading.Event()
        for _ in range(10 * WAIT_S):
            assert started.poll() is None, started.communicate()
            try:
                if httpx.get(f"{url}/readyz").status_code == 200:
                    break
            except httpx.TransportError:
                pass
            pause.wait(0.1)
        else:
            raise AssertionError("it did not become ready")
        yield started, url
    finally:
        started.kill()
        started.communicate()


def test_sigterm_under_load_loses_no_accepted_request() -> None:
    with process() as (started, url):
        answers: list[int] = []
        lost: list[str] = []
        stopping = threading.Event()

        def planner(number: int) -> None:
            with httpx.Client(base_url=url, timeout=60) as http:
                request = 0
                while not stopping.is_set():
                    request += 1
                    document = body(n=6, seed=100 * number + request)
                    try:
                        status = http.post("/v1/plan", json=document).status_code
                    except httpx.ConnectError:
                        return  # it listens no more
                    except httpx.TransportError as error:
                        lost.append(repr(error))
                        return
                    answers.append(status)
                    if status == 503:
                        return

        threads = [threading.Thread(target=planner, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        while len(answers) < 8:
            assert started.poll() is None
        started.send_signal(signal.SIGTERM)
        _, logged = started.communicate(timeout=WAIT_S)
        stopping.set()
        for thread in threads:
            thread.join()
        assert started.returncode == 0
        assert lost == []
        assert set(answers) == {200, 503}
        lines = [json.loads(line) for line in logged.splitlines()]
        assert [line["event"] for line in lines if line["event"] == "draining"] == ["draining"]
        # What the server counts as answered, its callers have.
        served = [line["status"] for line in lines if line.get("path") == "/v1/plan"]
        assert sorted(served) == sorted(answers)


def test_while_draining_it_says_so(engine: ScriptedEngine) -> None:
    settings = Settings(drain_notice_s=0.0)
    app = create_app(engine, settings)
    server = make_server(app, settings)
    with listening(app, 0, server) as (url, loop), httpx.Client(base_url=url, timeout=30) as http:
        served = Served(engine, url, http, loop)
        served.until_ready()
        served.in_loop(engine.may_finish.clear)
        answers: list[int] = []
        thread = threading.Thread(
            target=lambda: answers.append(http.post("/v1/plan", json=body()).status_code)
        )
        thread.start()
        served.until(lambda: len(engine.submitted) == 1)
        served.in_loop(server.drain)
        served.until(lambda: served.metric("looktwice_draining") == 1)
        refused = http.post("/v1/plan", json=body())
        problem(refused, "draining")
        assert refused.headers["Connection"] == "close"
        assert refused.headers["Retry-After"] == "1"
        problem(http.get("/readyz"), "draining")
        assert http.get("/healthz").status_code == 200
        assert served.metric("looktwice_ready") == 0
        assert answers == []
        served.in_loop(engine.may_finish.set)
        thread.join()
        assert answers == [200]


def test_draining_finishes_batches_and_labels(engine: ScriptedEngine) -> None:
    settings, teacher = Settings(drain_notice_s=0.0, max_draws=2), SlowTeacher()
    app = create_app(engine, settings, teacher=teacher)
    server = make_server(app, settings)
    with listening(app, 0, server) as (url, loop), httpx.Client(base_url=url, timeout=30) as http:
        served = Served(engine, url, http, loop)
        served.until_ready()
        served.in_loop(engine.may_finish.clear)
        answers: dict[str, httpx.Response] = {}

        def post(path: str, document: object) -> threading.Thread:
            def ask() -> None:
                answers[path] = httpx.post(url + path, json=document, timeout=30)

            thread = threading.Thread(target=ask)
            thread.start()
            return thread

        question = {
            "scene": body()["scene"],
            "predicted_plan": str(KEEP_ON),
            "expert_plan": str(SLOW_DOWN),
        }
        threads = [
            post("/v1/plan/batch", {"requests": [body(n=2) for _ in range(4)]}),
            post("/v1/label", question),
        ]
        served.until(lambda: len(engine.submitted) == 1 and teacher.asked == 1)
        served.in_loop(server.drain)
        served.until(lambda: served.metric("looktwice_draining") == 1)
        served.in_loop(engine.may_finish.set)
        threads[0].join()
        assert [result["status"] for result in answers["/v1/plan/batch"].json()["results"]] == [200] * 4
        assert "/v1/label" not in answers
        problem(http.post("/v1/label", json=question), "draining")
        served.in_loop(teacher.may_answer.set)
        threads[1].join()
        assert answers["/v1/label"].status_code == 200


def test_what_is_cut_off_at_the_end_of_a_drain_is_told_to_ask_elsewhere(
    engine: ScriptedEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("looktwice.service.http.server._LAST_WORDS_S", 0.2)
    settings = Settings(drain_notice_s=0.0)
    app = create_app(engine, settings)
    server = make_server(app, settings)
    with listening(app, 0, server) as (url, loop), httpx.Client(base_url=url, timeout=30) as http:
        served = Served(engine, url, http, loop)
        served.until_ready()
        with socket.create_connection(("127.0.0.1", int(url.rsplit(":", 1)[1])), 30) as half:
            half.sendall(b"POST /v1/plan HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\n{")
            served.until(lambda: len(server.server_state.tasks) > 0)
            served.in_loop(server.drain)
            told = b"".join(iter(lambda: half.recv(65536), b""))
    assert told.startswith(b"HTTP/1.1 503")
    assert b"draining" in told


def test_a_drain_ends_although_an_engine_never_finishes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody sets ``may_finish``: only the end of the drain can end the request, the engine, and the rest."""
    monkeypatch.setattr("looktwice.service.http.server._LAST_WORDS_S", 0.2)
    ended: list[str] = []

    class StuckEngine(ScriptedEngine):
        def cancel(self, request_id: str) -> None:
            ended.append("request")

        async def stop(self) -> None:
            ended.append("engine")

    class LastTeacher(SlowTeacher):
        async def close(self) -> None:
            ended.append("teacher")

    engine, settings = StuckEngine(), Settings(drain_s=0.5, drain_notice_s=0.0)
    app = create_app(engine, settings, teacher=LastTeacher())
    server = make_server(app, settings)
    with listening(app, 0, server) as (url, loop), httpx.Client(base_url=url, timeout=30) as http:
        served = Served(engine, url, http, loop)
        served.until_ready()
        served.in_loop(engine.may_finish.clear)
        answers: list[httpx.Response] = []
        thread = threading.Thread(
            target=lambda: answers.append(httpx.post(url + "/v1/plan", json=body(), timeout=30))
        )
        thread.start()
        served.until(lambda: len(engine.submitted) == 1)
        served.in_loop(server.drain)
        served.until(loop.is_closed)
        thread.join()
    assert "stopped before this was answered" in problem(answers[0], "draining").detail
    assert ended == ["request", "engine", "teacher"]


def test_it_does_not_open_itself_to_others_without_keys(engine: ScriptedEngine, tmp_path: Path) -> None:
    app = create_app(engine, Settings())
    for host in ("0.0.0.0", "::", "192.0.2.1", "looktwice.example"):
        with pytest.raises(ValueError, match="LOOKTWICE_API_KEYS_FILE"):
            make_server(app, Settings(), host)
    for host in ("127.0.0.1", "::1", "localhost"):
        make_server(app, Settings(), host)
    make_server(app, Settings(open=True), "0.0.0.0")
    (tmp_path / "keys").write_text(new_line("car")[1])
    make_server(app, Settings(api_keys_file=tmp_path / "keys"), "0.0.0.0")
    with pytest.raises(ValueError, match="who reaches the proxy"):
        check_who_may_ask(Settings(), "the proxy")


def test_keys_are_made_on_the_command_line() -> None:
    made = subprocess.run(
        [sys.executable, "-m", "looktwice.service.cli", "keys", "new", "car-7"],
        capture_output=True,
        text=True,
    )
    key, line = (text.split(": ", 1)[1].strip() for text in made.stdout.splitlines())
    assert re.fullmatch(r"car-7:[0-9a-f]{64}", line)
    assert key.startswith("lt_")
    strange = subprocess.run(
        [sys.executable, "-m", "looktwice.service.cli", "keys", "new", "a b"], capture_output=True, text=True
    )
    assert strange.returncode == 2


def test_a_log_that_nobody_reads_holds_up_nobody_and_dear_requests_are_refused() -> None:
    """Standard error is a pipe that is never emptied: it takes some hundred lines."""
    polite = make_call(RequestKind("direct", 1), [labelled_scene(8.0, pictures=1)], seed=1)
    with (
        process(subprocess.PIPE, **PATIENT) as (started, url),
        httpx.Client(base_url=url, timeout=600) as http,
    ):
        for _ in range(600):
            assert http.get("/v1/models").status_code == 200
        statuses = [
            http.post(call.path, content=never_seen(call.body), headers=dict(call.headers)).status_code
            for call in costly_calls(polite)
        ]
        # Scans, chunks, large pictures, scans that are taken; names, a name, points; maps; a chat; a file.
        assert statuses == [422, 422, 200, 200, 413, 413, 422, 400, 400, 422]
        lines = http.get("/metrics").text.splitlines()
        [lost] = [line for line in lines if line.startswith("looktwice_log_lines_lost_total ")]
        assert float(lost.split()[1]) > 0
        started.send_signal(signal.SIGTERM)
        assert started.wait(WAIT_S) == 0


def test_sigterm_while_pictures_are_decoded_ends_it() -> None:
    """Half a minute of decoding waits when the signal comes, and a tenth of a second is left for it.

    Every picture differs, as those that were seen before are not decoded again. What is left undone shows in
    the time of processors, which a busy machine does not change.
    """
    scenes, dear, numbers = 40, scans(20), itertools.count()
    settings = PATIENT | {"LOOKTWICE_MAX_DRAWS": str(scenes), "LOOKTWICE_DRAIN_S": "0.1"}
    answers: list[int | str] = []
    began_s = time.thread_time()
    decode_image(dear)
    waiting_s = 8 * scenes * (time.thread_time() - began_s)

    def ask(http: httpx.Client) -> None:
        document = body(n=1)
        for clip in document["scene"]["clips"]:
            # Bytes behind the end of a picture are not read.
            pictures = [dear + next(numbers).to_bytes(4, "big") for _ in clip["images"]]
            clip["images"] = [base64.b64encode(picture).decode() for picture in pictures]
        try:
            answers.append(http.post("/v1/plan", json=document).status_code)
        except httpx.TransportError as error:
            answers.append(repr(error))

    ended_before_s = _processors_s()
    with (
        process(subprocess.DEVNULL, LOOKTWICE_DRAIN_NOTICE_S="0", **settings) as (started, url),
        httpx.Client(base_url=url, timeout=600) as http,
    ):

        def metric(name: str) -> float:
            [value] = re.findall(rf"^{name} (.+)$", http.get("/metrics").text, re.M)
            return float(value)

        threads = [threading.Thread(target=ask, args=(http,)) for _ in range(scenes)]
        for thread in threads:
            thread.start()
        until(lambda: metric("looktwice_plans_in_flight") + len(answers) == scenes, WAIT_S, every_s=0.1)
        signalled_s = metric("process_cpu_seconds_total")
        started.send_signal(signal.SIGTERM)
        assert started.wait(WAIT_S) == 0
        for thread in threads:
            thread.join()
    assert set(answers) <= {200, 503}
    assert 503 in answers, "nothing was left to decode"
    assert _processors_s() - ended_before_s - signalled_s < waiting_s / 2


def _processors_s() -> float:
    """Time of processors that children took which have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_a_damaged_picture_is_told_as_one() -> None:
    damaged = body(noisy_scene(3))
    image = base64.b64decode(damaged["scene"]["clips"][0]["images"][1])
    damaged["scene"]["clips"][0]["images"][1] = base64.b64encode(image[:-200]).decode()
    engine = TorchEngine(CHECKPOINT, TorchSettings(rows=8, products=None))
    with serve(engine, Settings()) as served:
        answer = served.http.post("/v1/plan", json=damaged)
        assert "damaged" in problem(answer, "invalid-image").detail
        assert served.http.post("/v1/plan", json=body(noisy_scene(3), n=1)).status_code == 200
