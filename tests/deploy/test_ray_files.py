"""Ray's files: against Ray's own schema, KubeRay's resource, and each other."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.deploy.tools import DEPLOY, ROOT, check_kubernetes, documents

CONFIGURATIONS = [DEPLOY / "ray" / "serve.yaml", DEPLOY / "ray" / "serve-vllm.yaml"]
MANIFEST = DEPLOY / "ray" / "rayservice.yaml"


def read(path: Path) -> dict[str, Any]:
    told: dict[str, Any] = yaml.safe_load(path.read_text())
    return told


@pytest.fixture(scope="module")
def read_by_ray() -> list[dict[str, Any]]:
    command = [sys.executable, "-m", "tests.deploy.read_by_ray", *map(str, CONFIGURATIONS)]
    # Without settings: what is not in the files is not there.
    unset = {name: value for name, value in os.environ.items() if not name.startswith("LOOKTWICE_")}
    done = subprocess.run(
        command, cwd=ROOT, env=unset, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


def test_serve_and_the_application_know_every_key(read_by_ray: list[dict[str, Any]]) -> None:
    for path, found in zip(CONFIGURATIONS, read_by_ray, strict=True):
        assert found["kept"] == read(path)
        assert found["refused"] == ["row"]


def test_a_replica_does_not_open_itself_without_keys(read_by_ray: list[dict[str, Any]]) -> None:
    for found in read_by_ray:
        assert "LOOKTWICE_API_KEYS_FILE" in found["closed"]
        assert "Ray Serve" in found["closed"]


def test_no_queue_is_endless() -> None:
    for path in CONFIGURATIONS:
        (app,) = read(path)["applications"]
        assert app["deployments"][0]["max_queued_requests"] > 0


@pytest.fixture(scope="module")
def service() -> dict[str, Any]:
    found: dict[str, Any] = documents(MANIFEST.read_text())[0]
    return found


def test_kuberay_takes_the_service(service: dict[str, Any]) -> None:
    for document in documents(MANIFEST.read_text()):
        check_kubernetes(document)
    cluster = service["spec"]["rayClusterConfig"]
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        pod = {"metadata": {"name": "one"}} | group["template"]
        check_kubernetes({"apiVersion": "v1", "kind": "Pod"} | pod)


def test_it_runs_what_serve_yaml_says_on_the_ray_that_is_tested(
    service: dict[str, Any], read_by_ray: list[dict[str, Any]]
) -> None:
    assert yaml.safe_load(service["spec"]["serveConfigV2"]) == read(CONFIGURATIONS[0])
    assert service["spec"]["rayClusterConfig"]["rayVersion"] == read_by_ray[0]["ray"]


def test_a_worker_holds_one_replica_and_outlives_its_drain(service: dict[str, Any]) -> None:
    (app,) = read(CONFIGURATIONS[0])["applications"]
    (deployment,) = app["deployments"]
    (group,) = service["spec"]["rayClusterConfig"]["workerGroupSpecs"]
    pod = group["template"]["spec"]
    (worker,) = pod["containers"]
    assert int(worker["resources"]["limits"]["cpu"]) == deployment["ray_actor_options"]["num_cpus"]
    assert pod["terminationGracePeriodSeconds"] > deployment["graceful_shutdown_timeout_s"]
    assert {port["name"]: port["containerPort"] for port in worker["ports"]} == {
        "serve": read(CONFIGURATIONS[0])["http_options"]["port"],
        "looktwice": app["args"]["metrics_port"],
    }
    assert group["maxReplicas"] == deployment["autoscaling_config"]["max_replicas"]
