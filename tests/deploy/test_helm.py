"""The chart: linted, rendered for each use, and checked against Kubernetes' and its extensions' schemas."""

from __future__ import annotations

import json
from typing import Any

import helm_python
import pytest
import yaml
from jsonschema import Draft202012Validator, ValidationError
from typer.testing import CliRunner

from looktwice.service.cli.commands import app
from tests.deploy.tools import CHART, DASHBOARD, KUBERNETES, ROOT, RULES, check_kubernetes, render

EVERYTHING: dict[str, Any] = {
    "image": {"pullSecrets": [{"name": "registry"}]},
    "auth": {"open": True, "existingSecret": ""},
    "engine": {"threads": 4},
    "settings": {"LOOKTWICE_LOG_FORMAT": "console"},
    "settingsSecret": "teacher",
    "checkpoint": {"existingClaim": "checkpoints", "path": "rounds/2"},
    "sharedMemorySize": "1Gi",
    "podAnnotations": {"a": "b"},
    "podLabels": {"team": "planning"},
    "nodeSelector": {"kubernetes.io/arch": "amd64"},
    "tolerations": [{"operator": "Exists"}],
    "affinity": {"podAntiAffinity": {}},
    "topologySpreadConstraints": [
        {"maxSkew": 1, "topologyKey": "kubernetes.io/hostname", "whenUnsatisfiable": "DoNotSchedule"}
    ],
    "priorityClassName": "high",
    "runtimeClassName": "nvidia",
    "service": {"type": "LoadBalancer", "port": 8080, "annotations": {"a": "b"}},
    "ingress": {"enabled": True, "className": "nginx", "annotations": {"a": "b"}, "tlsSecret": "tls"},
    "networkPolicy": {
        "from": [{"namespaceSelector": {"matchLabels": {"team": "planning"}}}],
        "egress": [{"ports": [{"port": 53, "protocol": "UDP"}]}],
    },
    "keda": {"enabled": True},
    "monitoring": {
        "serviceMonitor": {"enabled": True, "labels": {"release": "prometheus"}},
        "rules": {"enabled": True, "labels": {"release": "prometheus"}},
        "dashboard": {"enabled": True},
    },
}


def values(name: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((CHART / f"values-{name}.yaml").read_text())
    return found


USES = {"default": {}, "cpu": values("cpu"), "gpu": values("gpu"), "everything": EVERYTHING}


@pytest.fixture(scope="module", params=USES)
def rendered(request: pytest.FixtureRequest) -> dict[tuple[str, str], dict[str, Any]]:
    return render(USES[request.param])


def container(rendered: dict[tuple[str, str], dict[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = pod(rendered)["containers"][0]
    return found


def pod(rendered: dict[tuple[str, str], dict[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = rendered["Deployment", "plan-looktwice"]["spec"]["template"]["spec"]
    return found


def test_helm_finds_nothing_to_warn_of() -> None:
    told = helm_python.lint(str(CHART), strict=True)
    assert told["errors"] == []
    assert [message for message in told["messages"] if message["error"] != "icon is recommended"] == []


def test_a_cluster_takes_all_of_it(rendered: dict[tuple[str, str], dict[str, Any]]) -> None:
    assert rendered
    for document in rendered.values():
        check_kubernetes(document)


def test_what_a_cluster_would_drop_is_found() -> None:
    for document in render(EVERYTHING).values():
        with pytest.raises(ValidationError, match="spce"):
            check_kubernetes(document | {"spce": {}})


def test_pods_can_do_as_little_as_possible(rendered: dict[tuple[str, str], dict[str, Any]]) -> None:
    spec, only = pod(rendered), container(rendered)
    assert spec["automountServiceAccountToken"] is False
    assert spec["securityContext"]["runAsNonRoot"] is True
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert only["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert only["resources"]["requests"].keys() >= {"cpu", "memory"}
    assert "memory" in only["resources"]["limits"]


def test_probes_ask_what_they_are_to_decide(rendered: dict[tuple[str, str], dict[str, Any]]) -> None:
    asked = {
        name: container(rendered)[f"{name}Probe"]["httpGet"]["path"] for name in ("liveness", "readiness")
    }
    assert asked == {"liveness": "/healthz", "readiness": "/readyz"}


def test_selectors_select_the_pods(rendered: dict[tuple[str, str], dict[str, Any]]) -> None:
    labels = rendered["Deployment", "plan-looktwice"]["spec"]["template"]["metadata"]["labels"].items()
    name = "plan-looktwice"
    assert rendered["Service", name]["spec"]["selector"].items() <= labels
    for kind, field in (("Deployment", "selector"), ("PodDisruptionBudget", "selector")):
        assert rendered[kind, name]["spec"][field]["matchLabels"].items() <= labels
    assert rendered["NetworkPolicy", name]["spec"]["podSelector"]["matchLabels"].items() <= labels


def test_the_command_takes_the_arguments() -> None:
    told = CliRunner().invoke(app, ["serve", "--help"], env={"COLUMNS": "200"}, color=False).output
    for use in USES.values():
        options = [word.split("=")[0] for word in container(render(use))["args"][1:]]
        assert [option for option in options if option not in told] == []


def test_a_number_of_replicas_is_set_by_one_only() -> None:
    assert render({})["Deployment", "plan-looktwice"]["spec"]["replicas"] == 2
    scaled = render(values("cpu"))
    assert "replicas" not in scaled["Deployment", "plan-looktwice"]["spec"]
    assert scaled["ScaledObject", "plan-looktwice"]["spec"]["scaleTargetRef"]["name"] == "plan-looktwice"


def test_a_pod_that_ends_listens_until_balancers_know_and_ends_in_time(
    rendered: dict[tuple[str, str], dict[str, Any]],
) -> None:
    settings = rendered["ConfigMap", "plan-looktwice"]["data"]
    notice_s, drain_s = (float(settings[f"LOOKTWICE_DRAIN_{name}"]) for name in ("NOTICE_S", "S"))
    # Endpoints are told to every node's proxy in about a second, on large clusters in a few.
    assert 3 <= notice_s < drain_s < pod(rendered)["terminationGracePeriodSeconds"]


def test_keys_are_asked_for_unless_it_is_said_otherwise() -> None:
    closed = render({"monitoring": {"serviceMonitor": {"enabled": True}}})
    settings = closed["ConfigMap", "plan-looktwice"]["data"]
    assert "LOOKTWICE_OPEN" not in settings
    (keys,) = [one for one in container(closed)["volumeMounts"] if one["name"] == "api-keys"]
    assert settings["LOOKTWICE_API_KEYS_FILE"].startswith(keys["mountPath"])
    assert "authorization" in closed["ServiceMonitor", "plan-looktwice"]["spec"]["endpoints"][0]
    opened = render(EVERYTHING)
    assert opened["ConfigMap", "plan-looktwice"]["data"]["LOOKTWICE_OPEN"] == "true"
    assert not [one for one in container(opened)["volumeMounts"] if one["name"] == "api-keys"]
    assert "authorization" not in opened["ServiceMonitor", "plan-looktwice"]["spec"]["endpoints"][0]


def test_rules_and_dashboard_are_those_of_compose() -> None:
    made = render(EVERYTHING)
    assert made["PrometheusRule", "plan-looktwice"]["spec"] == yaml.safe_load(RULES.read_text())
    board = made["ConfigMap", "plan-looktwice-dashboard"]["data"]["looktwice.json"]
    assert json.loads(board) == json.loads(DASHBOARD.read_text())


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"replica": 3}, "additional properties"),
        ({"engine": {"name": "onnx"}}, "value must be one of"),
        ({"settings": {"PATH": "/"}}, "does not match pattern"),
        ({"settings": {"LOOKTWICE_OPEN": "true"}}, "'not' failed"),
        ({"settings": {"LOOKTWICE_DRAIN_NOTICE_S": "9"}}, "'not' failed"),
        ({"drainSeconds": 60}, "longer than drainSeconds"),
        ({"drainNoticeSeconds": 25}, "longer than drainNoticeSeconds"),
        ({"engine": {"name": "vllm"}}, "needs engine.device cuda"),
        ({"engine": {"vllmArguments": {"seed": 1}}}, "need engine.name vllm"),
        ({"auth": {"existingSecret": ""}}, "auth.open=true"),
        ({"checkpoint": {"path": "a"}}, "go together"),
    ],
)
def test_values_that_cannot_work_are_refused(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(helm_python.HelmError, match=told):
        render(wrong)


def test_the_schema_is_strict_about_every_value() -> None:
    schema = json.loads((CHART / "values.schema.json").read_text())
    Draft202012Validator.check_schema(schema)
    defaults = yaml.safe_load((CHART / "values.yaml").read_text())
    Draft202012Validator(schema).validate(defaults)
    assert set(schema["properties"]) - {"global"} == set(defaults)


def test_versions_agree() -> None:
    chart = yaml.safe_load((CHART / "Chart.yaml").read_text())
    assert chart["kubeVersion"].startswith(f">={KUBERNETES[0]}.")
    project = (ROOT / "pyproject.toml").read_text()
    assert f'\nversion = "{chart["appVersion"]}"\n' in project
