"""The tools of deployment's own world, and where they look."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import helm_python
import kubernetes_validate
import yaml
from jsonschema import Draft202012Validator

ROOT: Final = Path(__file__).parents[2]
DEPLOY: Final = ROOT / "deploy"
CHART: Final = DEPLOY / "helm" / "looktwice"
RULES: Final = CHART / "monitoring" / "rules.yaml"
DASHBOARD: Final = CHART / "monitoring" / "dashboard.json"
KUBERNETES: Final = ("1.29", "1.37")
"""The oldest version that the chart admits, and the newest whose schemas are here."""
SCHEMAS: Final = Path(__file__).parent / "schemas"
_CUSTOM: Final = {
    ("keda.sh/v1alpha1", "ScaledObject"): "scaledobject",
    ("monitoring.coreos.com/v1", "PodMonitor"): "podmonitor",
    ("monitoring.coreos.com/v1", "PrometheusRule"): "prometheusrule",
    ("monitoring.coreos.com/v1", "ServiceMonitor"): "servicemonitor",
    ("ray.io/v1", "RayService"): "rayservice",
}


def run(tool: str, *arguments: object, told: str | None = None) -> str:
    """What a tool of this environment prints, which reads ``told``; fails when it finds fault, or warns."""
    command = Path(sys.executable).parent / tool
    assert command.exists(), f"{tool} is missing: make deploy-check installs it"
    done = subprocess.run(
        [command, *map(str, arguments)], capture_output=True, text=True, check=False, input=told
    )
    printed = done.stdout + done.stderr
    assert done.returncode == 0, printed
    assert "warn" not in printed.lower(), printed
    return printed


def documents(text: str) -> list[dict[str, Any]]:
    """The YAML documents of a manifest that are not empty."""
    return [document for document in yaml.safe_load_all(text) if document is not None]


def render(values: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    """What the chart makes of values, by kind and name."""
    with helm_python.Chart.load(str(CHART)) as chart:
        chart.validate_schema(values)
        texts = chart.render(values, name="plan", namespace="driving")
    made = [
        document for name, text in texts.items() if name.endswith(".yaml") for document in documents(text)
    ]
    return {(document["kind"], document["metadata"]["name"]): document for document in made}


def check_kubernetes(document: dict[str, Any]) -> None:
    """Fails on what a cluster would refuse or drop: unknown kinds and fields, and wrong types."""
    schema = _CUSTOM.get((document["apiVersion"], document["kind"]))
    if schema is None:
        for version in KUBERNETES:
            kubernetes_validate.validate(document, version, strict=True)
    else:
        Draft202012Validator(json.loads((SCHEMAS / f"{schema}.json").read_text())).validate(document)


def expressions() -> Iterator[tuple[str, str]]:
    """Every PromQL expression in `deploy/`, with where it is."""
    for group in yaml.safe_load(RULES.read_text())["groups"]:
        for rule in group["rules"]:
            yield rule.get("record") or rule["alert"], rule["expr"]
    board = json.loads(DASHBOARD.read_text())
    for panel in board["panels"]:
        for target in panel.get("targets", []):
            yield f"panel {panel['title']}", _without_variables(target["expr"])
    for note in board["annotations"]["list"]:
        yield f"annotation {note['name']}", note["expr"]
    for variable in board["templating"]["list"]:
        if variable["type"] == "query":
            metric, _ = variable["query"]["query"].removeprefix("label_values(").split(",")
            yield f"variable {variable['name']}", metric
    for (kind, _), document in render({"keda": {"enabled": True}}).items():
        if kind == "ScaledObject":
            for trigger in document["spec"]["triggers"]:
                yield f"trigger {trigger['name']}", trigger["metadata"]["query"]


def _without_variables(expression: str) -> str:
    for name, value in {"$__rate_interval": "1m", "$namespace": ".*", "$job": ".*"}.items():
        expression = expression.replace(name, value)
    assert "$" not in expression, expression
    return expression
