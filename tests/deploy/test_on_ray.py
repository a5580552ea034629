"""The service on a local Ray: replicas plan, and a burst is refused instead of waiting without end."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import psutil
import pytest
import yaml

from clients import wire
from clients.planner import Patience, PlannerClient
from model.bundled import SCENES
from model.driving.scene import Scene
from model.driving.scene_store import read_scenes
from tests.deploy.tools import DEPLOY, ROOT
from tests.service.serving import body

REPLICAS, ONGOING, QUEUED, BURST = 2, 1, 2, 16
START_S = 180


@pytest.fixture(scope="module")
def scene() -> Scene:
    return next(iter(read_scenes(SCENES))).scene


@pytest.fixture(scope="module")
def configuration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """serve.yaml, but small enough for any machine and its queue for a burst."""
    told = yaml.safe_load((DEPLOY / "ray" / "serve.yaml").read_text())
    with socket.create_server(("127.0.0.1", 0)) as free:
        told["http_options"] |= {"host": "127.0.0.1", "port": free.getsockname()[1]}
    (application,) = told["applications"]
    del application["args"]["metrics_port"]
    application["runtime_env"]["env_vars"]["OMP_NUM_THREADS"] = "1"
    (deployment,) = application["deployments"]
    deployment |= {"max_ongoing_requests": ONGOING, "max_queued_requests": QUEUED, "max_replicas_per_node": 8}
    deployment["autoscaling_config"] |= {"min_replicas": REPLICAS, "max_replicas": REPLICAS}
    deployment["ray_actor_options"] = {"num_cpus": 0.1}
    path = tmp_path_factory.mktemp("ray") / "serve.yaml"
    path.write_text(yaml.safe_dump(told))
    return path


@pytest.fixture(scope="module")
def serving(configuration: Path) -> Iterator[tuple[str, psutil.Process]]:
    """The address, and the process that all of Ray descends from."""
    options = yaml.safe_load(configuration.read_text())["http_options"]
    url = f"http://{options['host']}:{options['port']}"
    log = configuration.with_suffix(".log")
    with log.open("w") as told:
        process = subprocess.Popen(
            [Path(sys.executable).parent / "serve", "run", "--address", "local", configuration],
            cwd=ROOT,
            env=os.environ | {"RAY_USAGE_STATS_ENABLED": "0"},
            stdout=told,
            stderr=told,
        )
    try:
        until = time.monotonic() + START_S
        while not ready(url):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < until, log.read_text()
            time.sleep(0.2)
        yield url, psutil.Process(process.pid)
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(START_S)


def ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz", timeout=5).is_success
    except httpx.TransportError:
        return False


def test_replicas_plan_over_http(serving: tuple[str, psutil.Process], scene: Scene) -> None:
    url, process = serving
    names = Counter(one.name() for one in process.children(recursive=True))
    assert sum(count for name, count in names.items() if "ServeReplica" in name) == REPLICAS
    with PlannerClient(url, Patience(timeout_s=60)) as planner:
        answer = planner.plan(scene, wire.Controls(n=2, seed=1))
    assert [draw.trajectory.shape for draw in answer.draws] == [(64, 4)] * 2


def test_a_burst_is_refused_with_a_word_on_when_to_come_back(
    serving: tuple[str, psutil.Process], scene: Scene
) -> None:
    url, _ = serving
    request = body(scene, n=6)
    with httpx.Client(base_url=url, timeout=60) as http, ThreadPoolExecutor(BURST) as callers:
        answers = list(callers.map(lambda _: http.post("/v1/plan", json=request), range(BURST)))
    statuses = Counter(answer.status_code for answer in answers)
    assert statuses.keys() == {200, 429}
    assert statuses[200] >= REPLICAS * ONGOING
    assert {answer.headers["retry-after"] for answer in answers if answer.status_code == 429} == {"1"}
    assert httpx.post(f"{url}/v1/plan", json=request, timeout=60).is_success


def test_what_is_wrong_with_a_request_is_told_as_ever(serving: tuple[str, psutil.Process]) -> None:
    url, _ = serving
    answer = httpx.post(f"{url}/v1/plan", json={})
    assert answer.status_code == 422
    assert answer.headers["content-type"] == wire.PROBLEM_MEDIA_TYPE
