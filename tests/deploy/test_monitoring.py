"""Rules, alerts and the dashboard: that they hold, and that they speak of what /metrics shows."""

from __future__ import annotations

import json
import re
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
import yaml
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.dashboard import Dashboard
from prometheus_client.parser import text_string_to_metric_families

from looktwice.service.operations.settings import Settings
from tests.deploy.tools import DASHBOARD, ROOT, RULES, expressions, run
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import body, serve

SCRAPED_LABELS = {"job", "instance", "namespace", "service", "pod", "le"}
FOREIGN = {"ALERTS"}
WORDS = {"by", "or", "unless", "and", "on", "without", "ignoring", "bool", "offset"}


@pytest.fixture(scope="module")
def exposed() -> dict[str, str]:
    """What a service shows at /metrics: before it was asked anything, and after."""
    with serve(ScriptedEngine(), Settings()) as served:
        before = served.http.get("/metrics").text
        for thinking in ("always", "never", "adaptive"):
            assert served.http.post("/v1/plan", json=body(thinking=thinking, deadline_ms=60_000)).is_success
        return {"before": before, "after": served.http.get("/metrics").text}


@pytest.fixture(scope="module")
def shown(exposed: dict[str, str]) -> dict[str, set[str]]:
    """Names of samples at /metrics, and the labels seen on them."""
    suffixes = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count"), "gauge": ("",)}
    names: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(exposed["after"]):
        for suffix in suffixes[family.type]:
            names[family.name + suffix] = set()
        for sample in family.samples:
            names.setdefault(sample.name, set()).update(sample.labels)
    return names


def recorded() -> set[str]:
    groups = yaml.safe_load(RULES.read_text())["groups"]
    return {rule["record"] for group in groups for rule in group["rules"] if "record" in rule}


def bare(expression: str) -> str:
    """The expression without strings, selectors, ranges and label lists: names are left."""
    without = re.sub(r'"[^"]*"', "", expression)
    without = re.sub(r"\{[^}]*\}|\[[^]]*\]", "", without)
    return re.sub(r"\b(by|without|on|ignoring)\s*\([^)]*\)", "", without)


def metrics(expression: str) -> set[str]:
    names = re.findall(r"(?<![\w:.])[A-Za-z_][\w:]*(?![\w:]|\s*\()", bare(expression))
    return set(names) - WORDS


def test_metrics_are_found_in_expressions() -> None:
    expression = 'sum by (le) (rate(a_bucket{x="b c"}[5m])) / on (x) (looktwice:d:e > bool 1e3) or 0 * f'
    assert metrics(expression) == {"a_bucket", "looktwice:d:e", "f"}


def test_every_metric_is_one_that_the_service_shows(shown: dict[str, set[str]]) -> None:
    known = shown.keys() | recorded() | FOREIGN
    unknown = {where: metrics(expression) - known for where, expression in expressions()}
    assert {where: names for where, names in unknown.items() if names} == {}
    assert all(metrics(expression) for _, expression in expressions())


def test_every_label_is_one_that_the_metric_has(shown: dict[str, set[str]]) -> None:
    """As far as its samples show labels: a counter has none before it counts."""
    for where, expression in expressions():
        for metric, selector in re.findall(r"([A-Za-z_]\w*)\{([^}]*)\}", expression):
            named = set(re.findall(r"(\w+)\s*(?:=~|!~|!=|=)", selector)) - SCRAPED_LABELS
            if shown.get(metric):
                assert named <= shown[metric], (where, metric)


@pytest.mark.parametrize("when", ["before", "after"])
def test_metrics_are_named_as_prometheus_wants_them(exposed: dict[str, str], when: str) -> None:
    assert run("promtool", "check", "metrics", told=exposed[when]) == ""


def test_what_only_grows_is_a_counter(shown: dict[str, set[str]]) -> None:
    assert "looktwice_log_lines_lost_total" in shown


def test_rules_are_in_order() -> None:
    assert "SUCCESS" in run("promtool", "check", "rules", "--lint=all", "--lint-fatal", RULES)


def test_rules_say_what_they_are_to_say() -> None:
    assert "SUCCESS" in run("promtool", "test", "rules", Path(__file__).parent / "rules_test.yaml")


def test_every_rule_is_tested() -> None:
    tested = (Path(__file__).parent / "rules_test.yaml").read_text()
    assert {name for name in recorded() if name not in tested} == set()
    assert {alert["alert"] for alert in alerts() if alert["alert"] not in tested} == set()


def test_every_expression_is_promql(tmp_path: Path) -> None:
    rules = [
        {"record": f"expression{number}", "expr": expression}
        for number, (_, expression) in enumerate(expressions())
    ]
    path = tmp_path / "rules.yaml"
    path.write_text(yaml.safe_dump({"groups": [{"name": "all", "rules": rules}]}))
    assert f"{len(rules)} rules found" in run("promtool", "check", "rules", path)


def alerts() -> list[dict[str, Any]]:
    groups = yaml.safe_load(RULES.read_text())["groups"]
    return [rule for group in groups for rule in group["rules"] if "alert" in rule]


def test_an_alert_says_how_bad_it_is() -> None:
    for alert in alerts():
        assert alert["for"]
        assert alert["labels"]["severity"] in ("warning", "critical")
        assert alert["annotations"]["summary"].endswith(".")


def test_an_alert_says_what_to_do() -> None:
    links = {tuple(alert["annotations"]["runbook_url"].split("#")) for alert in alerts()}
    assert len(links) == len(alerts())
    pages = {page: headings(ROOT / page) for page, _ in links}
    assert {link for link in links if link[1] not in pages[link[0]]} == set()


def headings(page: Path) -> set[str]:
    """Anchors of a page's headings, as Markdown viewers make them."""
    found = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in found}


def test_grafana_knows_every_key_of_the_dashboard() -> None:
    told = json.loads(DASHBOARD.read_text())
    kept = json.loads(JSONEncoder().encode(Dashboard.from_json(told)))
    assert list(lost(told, kept)) == []


def lost(told: Any, kept: Any, where: str = "") -> list[str]:
    """Where a reader of the dashboard's schema dropped or changed something."""
    if isinstance(told, dict):
        return [
            place
            for key, value in told.items()
            for place in (lost(value, kept[key], f"{where}/{key}") if key in kept else [f"{where}/{key}"])
        ]
    if isinstance(told, list):
        return [
            place
            for number, (one, other) in enumerate(zip(told, kept, strict=True))
            for place in lost(one, other, f"{where}/{number}")
        ]
    return [] if told == kept else [where]


def test_panels_are_told_apart_explained_and_side_by_side() -> None:
    panels = json.loads(DASHBOARD.read_text())["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    for panel in panels:
        place = panel["gridPos"]
        assert 0 <= place["x"] < place["x"] + place["w"] <= 24
        if panel["type"] != "row":
            assert panel["description"].endswith(".")
            references = [target["refId"] for target in panel["targets"]]
            assert len(set(references)) == len(references) > 0
    for one, other in combinations((panel["gridPos"] for panel in panels), 2):
        beside = one["x"] + one["w"] <= other["x"] or other["x"] + other["w"] <= one["x"]
        above = one["y"] + one["h"] <= other["y"] or other["y"] + other["h"] <= one["y"]
        assert beside or above, (one, other)


def test_every_metric_the_service_shows_is_looked_at(shown: dict[str, set[str]]) -> None:
    named = set().union(*(metrics(expression) for _, expression in expressions()))
    own = (name for name in shown if not name.startswith("process_"))
    families = {re.sub(r"_(total|bucket|sum|count)$", "", name) for name in own}
    assert {name for name in families if not any(one.startswith(name) for one in named)} == set()
