"""Which test checks which file of `deploy/`; run as a module, it prints them all."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import Final

from tests.deploy.tools import ROOT

CHECKED: Final = {
    "deploy/compose/*.yaml": "test_compose: compose specification, promtool",
    "deploy/compose/grafana/*.yaml": "test_compose: what is provisioned is there",
    "deploy/docker/*.Dockerfile": "test_docker: hadolint",
    "deploy/docker/*.constraints.txt": "test_docker: agrees with pyproject.toml",
    "deploy/helm/looktwice/*": "test_helm: lint, schema of values; test_scaling: when replicas are added",
    "deploy/helm/looktwice/monitoring/*.json": "test_monitoring: Grafana's schema, promtool, /metrics",
    "deploy/helm/looktwice/monitoring/*.yaml": "test_monitoring: promtool with unit tests, /metrics",
    "deploy/helm/looktwice/templates/*": "test_helm: rendered; Kubernetes, KEDA, Prometheus operator",
    "deploy/ray/app.py": "test_on_ray: run on a local Ray",
    "deploy/ray/rayservice.yaml": "test_ray_files: KubeRay, Kubernetes, Prometheus operator",
    "deploy/ray/serve*.yaml": "test_ray_files: Ray Serve; test_scaling: when replicas are added",
    "__init__.py": "mypy",
    "deploy/vllm/*": "make test-vllm: installed and run",
}


def checks() -> Iterator[tuple[str, str | None]]:
    """Every tracked file of `deploy/` with what checks it, or None."""
    told = subprocess.run(["git", "ls-files", "deploy"], cwd=ROOT, capture_output=True, text=True, check=True)
    for file in told.stdout.splitlines():
        found = (check for pattern, check in CHECKED.items() if PurePosixPath(file).match(pattern))
        yield file, next(found, None)


if __name__ == "__main__":
    for file, check in checks():
        print(f"{file:55} {check}")
