"""The service on a local Ray, in the shipped proportions: load adds a replica, and a burst is refused."""

from __future__ import annotations

import copy
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import httpx
import psutil
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from looktwice.clients import wire
from looktwice.clients.planner import PlannerClient, RetryPolicy
from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene import Scene
from looktwice.model.driving.scene_store import read_scenes
from tests.deploy.tools import DEPLOY, ROOT
from tests.service.serving import body
from tests.sockets import free_port

SERVE: Final[dict[str, Any]] = yaml.safe_load((DEPLOY / "ray" / "serve.yaml").read_text())
SHIPPED: Final[dict[str, Any]] = SERVE["applications"][0]["deployments"][0]
ONGOING, QUEUED = SHIPPED["max_ongoing_requests"], SHIPPED["max_queued_requests"]
REPLICAS = 2
"""As many as are added to the one at the beginning make."""
BURST = 2 * (REPLICAS * ONGOING + QUEUED)
START_S = 600
PATIENT: Final = {
    "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "60",
    "RAY_SERVE_PROXY_HEALTH_CHECK_TIMEOUT_S": "60",
}
"""By default Ray kills a proxy that has not started within 5 s, which a busy machine takes longer for."""
ANSWER_S = 120


@pytest.fixture(scope="module")
def scene() -> Scene:
    return next(iter(read_scenes(SCENES))).scene


@pytest.fixture(scope="module")
def configuration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """serve.yaml, but for replicas that are small enough for any machine, and quick to come."""
    told = copy.deepcopy(SERVE)
    told["http_options"] |= {"host": "127.0.0.1", "port": free_port()}
    (application,) = told["applications"]
    del application["args"]["metrics_port"]
    # However busy the machine: who is refused is a matter of numbers here, not of speed.
    application["runtime_env"]["env_vars"] |= {
        "OMP_NUM_THREADS": "1",
        "LOOKTWICE_QUEUE_TIMEOUT_S": str(ANSWER_S),
    }
    (deployment,) = application["deployments"]
    deployment |= {"max_replicas_per_node": REPLICAS, "ray_actor_options": {"num_cpus": 0.1}}
    soon = {"upscale_delay_s": 1, "metrics_interval_s": 1, "look_back_period_s": 2}
    deployment["autoscaling_config"] |= soon | {"max_replicas": REPLICAS}
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
            env=os.environ | {"RAY_USAGE_STATS_ENABLED": "0"} | PATIENT,
            stdout=told,
            stderr=told,
            # A shell's background jobs ignore it, and `serve run` ends by nothing else.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
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


def ask(url: str, scene: Scene) -> httpx.Response:
    """Of six draws, as callers ask by default; without second looks, which take longer."""
    return httpx.post(f"{url}/v1/plan", json=body(scene, n=6, thinking="never"), timeout=ANSWER_S)


def replica_that_answers(url: str) -> float:
    """When the replica was made whose metrics these are, in s since 1970: no two have the same."""
    told = httpx.get(f"{url}/metrics", timeout=ANSWER_S).raise_for_status().text
    samples = (sample for family in text_string_to_metric_families(told) for sample in family.samples)
    return next(each.value for each in samples if each.name == "process_start_time_seconds")


def test_a_replica_plans_over_http(serving: tuple[str, psutil.Process], scene: Scene) -> None:
    url, process = serving
    names = Counter(one.name() for one in process.children(recursive=True))
    assert sum(count for name, count in names.items() if "ServeReplica" in name) == 1
    with PlannerClient(url, RetryPolicy(timeout_s=60)) as planner:
        answer = planner.plan(scene, wire.Controls(n=2, seed=1))
    assert [draw.trajectory.shape for draw in answer.draws] == [(64, 4)] * 2


def test_load_adds_a_replica_and_is_not_refused(serving: tuple[str, psutil.Process], scene: Scene) -> None:
    """One replica takes all that Ray gives it at once; meanwhile another one comes."""
    url, _ = serving
    enough = threading.Event()

    def keep_asking() -> Counter[int]:
        told = Counter[int]()
        while not enough.is_set():
            told[ask(url, scene).status_code] += 1
        return told

    with ThreadPoolExecutor(ONGOING) as callers:
        asking = [callers.submit(keep_asking) for _ in range(ONGOING)]
        try:
            replicas, until = set[float](), time.monotonic() + START_S
            while len(replicas) < REPLICAS:
                assert time.monotonic() < until
                replicas.add(replica_that_answers(url))
                time.sleep(0.2)
        finally:
            enough.set()
    assert {status for each in asking for status in each.result()} == {200}


def test_a_burst_is_refused_by_ray_with_a_word_on_when_to_come_back(
    serving: tuple[str, psutil.Process], scene: Scene
) -> None:
    url, _ = serving
    with ThreadPoolExecutor(BURST) as callers:
        answers = list(callers.map(lambda _: ask(url, scene), range(BURST)))
    statuses = Counter(answer.status_code for answer in answers)
    assert statuses.keys() == {200, 429}
    assert statuses[200] >= REPLICAS * ONGOING
    refused = [answer for answer in answers if answer.status_code == 429]
    assert {answer.headers["retry-after"] for answer in refused} == {"1"}
    # Of what Ray lets in, replicas refuse nothing.
    assert wire.PROBLEM_MEDIA_TYPE not in {answer.headers["content-type"] for answer in refused}
    assert ask(url, scene).is_success


def test_what_is_wrong_with_a_request_is_told_as_ever(serving: tuple[str, psutil.Process]) -> None:
    url, _ = serving
    answer = httpx.post(f"{url}/v1/plan", json={})
    assert answer.status_code == 422
    assert answer.headers["content-type"] == wire.PROBLEM_MEDIA_TYPE
