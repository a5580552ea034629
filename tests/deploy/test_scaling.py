"""Replicas are added wherever callers are refused, by what is shipped: KEDA's triggers, and Ray's targets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

import looktwice.clients.wire as wire
from looktwice.service.operations.settings import Settings
from tests.deploy.tools import CHART, DEPLOY, render, run
from tests.service.admission.test_limits import waiting
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import body, serve

DRAWS = wire.Controls().n
"""Of a scene whose caller does not say how many."""
TOLERANCE = 0.1
"""Kubernetes' autoscaler changes nothing for so little."""
SCRAPE_S = 15
FEW = 0.1
"""Share of scenes that may be refused where nothing asks for more replicas."""


@dataclass(frozen=True)
class Shipped:
    """What one of the chart's files of values comes to."""

    max_draws: int
    rows: int
    keda: dict[str, Any]
    triggers: dict[str, dict[str, str]]

    def fewest_and_most(self) -> range:
        """Numbers of replicas that another one can be added to."""
        return range(self.keda["minReplicaCount"], self.keda["maxReplicaCount"])


@pytest.fixture(scope="module", params=["cpu", "gpu"])
def shipped(request: pytest.FixtureRequest) -> Shipped:
    made = render(yaml.safe_load((CHART / f"values-{request.param}.yaml").read_text()))
    settings = made["ConfigMap", "plan-looktwice"]["data"]
    (container,) = made["Deployment", "plan-looktwice"]["spec"]["template"]["spec"]["containers"]
    (rows,) = (word for word in container["args"] if word.startswith("--rows="))
    keda = made["ScaledObject", "plan-looktwice"]["spec"]
    assert {trigger["metricType"] for trigger in keda["triggers"]} == {"AverageValue"}
    return Shipped(
        int(settings.get("LOOKTWICE_MAX_DRAWS", Settings.model_fields["max_draws"].default)),
        int(rows.removeprefix("--rows=")),
        keda,
        {trigger["name"]: trigger["metadata"] for trigger in keda["triggers"]},
    )


def moment(shipped: Shipped, replicas: int, more: set[str], **shown: float) -> dict[str, Any]:
    """A test for promtool: these triggers want ``more`` while each replica shows this for minutes.

    Args:
        shipped: the triggers.
        replicas: as many there are.
        more: names of the triggers that are to ask for another one.
        shown: values of gauges, without their prefix; ``refused`` are requests a second.
    """
    refused = round(SCRAPE_S * shown.pop("refused", 0))
    samples = {f"looktwice_{name}{{%s}}": f"{value:g}x20" for name, value in shown.items()}
    samples['looktwice_rejections_total{%s, reason="queue-full"}'] = f"0+{refused}x20"
    # Of the same cluster, and none of its affair.
    samples['looktwice_rejections_total{%s, reason="rate-limited"}'] = "0+900x20"
    where = 'namespace="driving", service="plan-looktwice", pod="{}"'
    return {
        "interval": f"{SCRAPE_S}s",
        "input_series": [
            {"series": series % where.format(pod), "values": values}
            for pod in range(replicas)
            for series, values in samples.items()
        ],
        "promql_expr_test": [
            {
                # KEDA takes no value for none.
                "expr": f"(({trigger['query']}) or vector(0)) / {trigger['threshold']}"
                f" > bool {replicas * (1 + TOLERANCE):g}",
                "eval_time": f"{20 * SCRAPE_S}s",
                "exp_samples": [{"labels": "{}", "value": int(name in more)}],
            }
            for name, trigger in shipped.triggers.items()
        ],
    }


def hold(tmp_path: Path, moments: list[dict[str, Any]]) -> None:
    path = tmp_path / "triggers.yaml"
    path.write_text(yaml.safe_dump({"rule_files": [], "tests": moments}))
    assert "SUCCESS" in run("promtool", "test", "rules", path)


def test_a_service_that_refuses_shows_what_is_scaled_by() -> None:
    """As the chart sets it, nothing waits then, and few of the engine's rows are in use."""
    engine = ScriptedEngine()
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    with serve(engine, Settings(max_draws=values["settings"]["LOOKTWICE_MAX_DRAWS"])) as served:
        served.in_loop(engine.may_finish.clear)
        with waiting(served, DRAWS), waiting(served, DRAWS):
            assert served.http.post("/v1/plan", json=body(n=DRAWS)).status_code == 429
            served.until(lambda: served.metric("looktwice_queue_draws") == 0)
            assert served.metric("looktwice_accepted_draws") == served.metric("looktwice_capacity_draws")
            assert served.metric("looktwice_kv_rows_used") < 0.5 * served.metric("looktwice_kv_rows")
            assert served.metric("looktwice_rejections_total", reason="queue-full") == 1


def test_where_callers_are_refused_there_is_always_another_replica(shipped: Shipped, tmp_path: Path) -> None:
    full = {"capacity_draws": shipped.max_draws, "queue_draws": 0}
    hold(
        tmp_path,
        [
            moment(shipped, replicas, more, accepted_draws=share * shipped.max_draws, refused=refused, **full)
            for replicas in shipped.fewest_and_most()
            for share, refused, more in (
                (1, 1, {"busy-replicas", "refused-requests"}),
                (1, 0, {"busy-replicas"}),
                # Scenes of many draws are refused where there is room for others.
                (0, 0.2, {"refused-requests"}),
            )
        ],
    )


def test_a_queue_adds_replicas(shipped: Shipped, tmp_path: Path) -> None:
    """One that plans can make: all that is accepted but one scene, which the engine works on."""
    shown = {"capacity_draws": shipped.max_draws, "queue_draws": shipped.max_draws - DRAWS}
    hold(
        tmp_path,
        [
            moment(shipped, replicas, {"waiting-draws"}, accepted_draws=0, **shown)
            for replicas in shipped.fewest_and_most()
        ],
    )


def test_replicas_that_have_room_are_enough(shipped: Shipped, tmp_path: Path) -> None:
    share = float(shipped.triggers["busy-replicas"]["threshold"])
    quiet = {"capacity_draws": shipped.max_draws, "queue_draws": 0}
    hold(
        tmp_path,
        [
            moment(shipped, 2, set(), accepted_draws=share * shipped.max_draws, **quiet),
            moment(shipped, 2, set(), accepted_draws=0, **quiet),
            moment(shipped, 2, set()),
        ],
    )


def test_replicas_that_are_busy_enough_refuse_few(shipped: Shipped) -> None:
    share = float(shipped.triggers["busy-replicas"]["threshold"])
    assert refused_by_chance(shipped.max_draws // DRAWS, share) < FEW


def refused_by_chance(places: int, share: float) -> float:
    """Share of scenes that find no place where ``share`` of ``places`` is taken on average, after Erlang."""
    lost = offered = 0.0
    while offered * (1 - lost) < share * places:
        offered += 0.01
        lost = 1.0
        for place in range(1, places + 1):
            lost = offered * lost / (place + offered * lost)
    return lost


def test_what_is_refused_by_chance_is_known() -> None:
    assert refused_by_chance(2, 0.25) == pytest.approx(1 / 11, rel=0.05)
    assert refused_by_chance(2, 0.7) == pytest.approx(1 / 2, rel=0.05)
    assert refused_by_chance(21, 0.7) == pytest.approx(1 / 30, rel=0.1)


def test_all_that_is_accepted_can_be_decoded_at_once(shipped: Shipped) -> None:
    assert shipped.max_draws <= shipped.rows


@pytest.mark.parametrize("name", ["serve", "serve-vllm"])
def test_replicas_of_ray_take_what_ray_gives_them_and_ray_adds_some(name: str) -> None:
    (app,) = yaml.safe_load((DEPLOY / "ray" / f"{name}.yaml").read_text())["applications"]
    (deployment,) = app["deployments"]
    max_draws = int(app["runtime_env"]["env_vars"]["LOOKTWICE_MAX_DRAWS"])
    ongoing, scaling = deployment["max_ongoing_requests"], deployment["autoscaling_config"]
    assert ongoing * DRAWS <= max_draws <= app["args"]["rows"]
    assert ongoing <= Settings.model_fields["max_scenes"].default
    # A replica that is full asks for another one, and what then waits for as many as there may be.
    assert scaling["target_ongoing_requests"] <= ongoing / 2
    assert deployment["max_queued_requests"] >= ongoing
