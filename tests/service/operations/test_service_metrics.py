from __future__ import annotations

from dataclasses import replace

from prometheus_client.openmetrics import parser as openmetrics
from prometheus_client.parser import text_string_to_metric_families

from looktwice.service.operations.service_metrics import LATENCY_BUCKETS_S
from tests.service.scenes import history, scene
from tests.service.serving import Served, body


def test_draws_are_counted_by_branch_and_by_who_decided(served: Served) -> None:
    served.http.post("/v1/plan", json=body(n=3, thinking="always"))
    served.http.post("/v1/plan", json=body(n=2, thinking="never"))
    count = "looktwice_branches_total"
    assert served.metric(count, branch="think", thinking="always", endpoint="plan") == 3
    assert served.metric(count, branch="direct", thinking="never") == 2
    assert served.metric(count, thinking="adaptive") == 0
    assert served.metric("looktwice_think_probability_count") == 5


def test_tokens_are_counted_by_section(served: Served) -> None:
    served.http.post("/v1/plan", json=body(n=3, thinking="always"))
    served.http.post("/v1/plan", json=body(n=1, thinking="never"))
    assert served.metric("looktwice_section_tokens_sum", section="plan") == 4 * 40
    assert served.metric("looktwice_section_tokens_count", section="thinking") == 3
    assert served.metric("looktwice_section_tokens_sum", section="thinking") == 3 * 48


def test_a_draw_that_disagrees_twice_is_one_inconsistent_draw(served: Served) -> None:
    # It waits first, and stands still where its revised plan slows down: that is neither slower than
    # before, as its reasoning asks for, nor what the trajectory does.
    stands = replace(scene(), history=history(speed_mps=0.0))
    waits = "- longitudinal\n  - 0.0s-6.4s: Wait\n"
    asked = served.http.post("/v1/plan", json=body(stands, n=3, thinking="always", prefill=waits))
    assert [draw["disagreements"] for draw in asked.json()["draws"]] == [
        ["plan_trajectory", "reason_change"]
    ] * 3
    count = "looktwice_inconsistent_draws_total"
    labels = {"branch": "think", "thinking": "always", "endpoint": "plan"}
    assert served.metric(count, **labels) == served.metric("looktwice_branches_total", **labels) == 3
    for parts in ("plan_trajectory", "reason_change"):
        assert served.metric("looktwice_disagreements_total", parts=parts, endpoint="plan") == 3

    assert served.http.post("/v1/plan", json=body(n=2, thinking="always")).json()["draws"][0]["consistent"]
    assert served.metric(count, **labels) == 3, "draws whose parts agree are none"
    served.http.post("/v1/plan", json=body(n=2, thinking="never"))
    begun = f'{count}{{branch="direct",endpoint="plan",thinking="never"}} 0.0'
    assert begun in served.http.get("/metrics").text, "a share of them begins at 0"


def test_requests_are_counted_by_endpoint_and_status(served: Served) -> None:
    served.http.post("/v1/plan", json=body())
    served.http.post("/v1/plan", json={})
    for unknown in ("/a", "/b"):
        served.http.get(unknown)
    count = "looktwice_requests_total"
    assert served.metric(count, endpoint="/v1/plan", method="POST", status="200") == 1
    assert served.metric(count, endpoint="/v1/plan", method="POST", status="422") == 1
    assert served.metric(count, endpoint="(none)", status="404") == 2
    assert served.metric("looktwice_request_seconds_count", endpoint="/v1/plan", status="2xx") == 1
    for edge in LATENCY_BUCKETS_S:
        assert f'endpoint="/v1/plan",le="{edge}"' in served.http.get("/metrics").text


def test_labels_do_not_come_from_callers(served: Served) -> None:
    served.http.request("BREW", "/v1/plan")
    served.http.get("/v1/scenes/made-up-name")
    text = served.http.get("/metrics").text
    assert "BREW" not in text
    assert "made-up-name" not in text


def test_metrics_come_in_both_formats_without_when_each_began(served: Served) -> None:
    assert served.http.post("/v1/plan", json=body()).is_success
    plain = served.http.get("/metrics")
    assert plain.headers["content-type"].startswith("text/plain; version=0.0.4")
    asked = "application/openmetrics-text;version=1.0.0;q=0.8,text/plain;version=0.0.4;q=0.3"
    opened = served.http.get("/metrics", headers={"Accept": asked})
    assert opened.headers["content-type"].startswith("application/openmetrics-text; version=1.0.0")
    names = [
        {family.name for family in parse(text)}
        for parse, text in (
            (text_string_to_metric_families, plain.text),
            (openmetrics.text_string_to_metric_families, opened.text),
        )
    ]
    assert names[0] == names[1]
    assert {"looktwice_requests", "process_resident_memory_bytes", "process_open_fds"} <= names[0]
    assert "_created" not in plain.text + opened.text
