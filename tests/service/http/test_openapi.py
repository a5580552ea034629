from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from fastapi.openapi.utils import get_openapi

from looktwice.clients.wire import PlanRequest
from looktwice.service.app import create_app
from looktwice.service.http.auth import OPEN_PATHS
from looktwice.service.operations.settings import Settings
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served
from tests.sockets import PATIENCE_S


@pytest.fixture(scope="module")
def description(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    none: Path = tmp_path_factory.mktemp("none") / "none.parquet"
    return create_app(ScriptedEngine(), Settings(bundled_scenes=none)).openapi()


def test_others_are_answered_while_it_is_made(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go_on = Event(), Event()

    def slow(**options: Any) -> dict[str, Any]:
        begun.set()
        assert go_on.wait(PATIENCE_S)
        return get_openapi(**options)

    monkeypatch.setattr("fastapi.applications.get_openapi", slow)
    with ThreadPoolExecutor() as pool:
        asking = [pool.submit(served.http.get, "/openapi.json") for _ in range(2)]
        assert begun.wait(PATIENCE_S)
        try:
            assert served.http.get("/healthz").status_code == 200
        finally:
            go_on.set()
        first, second = (each.result().json() for each in asking)
    assert first == second
    assert first["servers"]


def test_every_error_is_described_as_a_problem(description: dict[str, Any]) -> None:
    for path, operations in description["paths"].items():
        for operation in operations.values():
            responses = operation["responses"]
            assert {"200", "500"} <= responses.keys()
            assert ("421" in responses) == (path not in OPEN_PATHS)
            for status, response in responses.items():
                if status != "200":
                    (media_type,) = response["content"]
                    assert media_type == "application/problem+json"
                    assert response["content"][media_type]["schema"] == {
                        "$ref": "#/components/schemas/Problem"
                    }
    plan = description["paths"]["/v1/plan"]["post"]["responses"]
    refusals = {"400", "401", "408", "413", "415", "421", "422", "429", "500", "503", "504"}
    assert plan.keys() == {"200"} | refusals
    assert "image" not in description["components"]["schemas"]
    assert "HTTPValidationError" not in description["components"]["schemas"]


def test_chats_are_refused_as_openai_does(description: dict[str, Any]) -> None:
    responses = description["paths"]["/v1/chat/completions"]["post"]["responses"]
    assert "422" not in responses
    examples = responses["400"]["content"]["application/problem+json"]["examples"]
    assert {"invalid-json", "invalid-request", "invalid-image"} <= examples.keys()
    for slug, example in examples.items():
        assert (example["value"]["status"], example["value"]["error"]["code"]) == (400, slug)
    (unknown,) = responses["404"]["content"]["application/problem+json"]["examples"].values()
    assert unknown["value"]["error"]["type"] == "invalid_request_error"


def test_every_reference_leads_somewhere(description: dict[str, Any]) -> None:
    def references(node: Any) -> list[str]:
        if isinstance(node, dict):
            own = [node["$ref"]] if "$ref" in node else []
            return own + [found for value in node.values() for found in references(value)]
        return [found for value in node for found in references(value)] if isinstance(node, list) else []

    known = description["components"]["schemas"]
    assert {reference.removeprefix("#/components/schemas/") for reference in references(description)} <= set(
        known
    )


def test_the_example_can_be_sent_as_it_is(description: dict[str, Any], served: Served) -> None:
    content = description["paths"]["/v1/plan"]["post"]["requestBody"]["content"]["application/json"]
    (example,) = content["examples"].values()
    PlanRequest.model_validate(example["value"])
    assert served.http.post("/v1/plan", json=example["value"]).status_code == 200


@pytest.mark.parametrize("path", ["/v1/plan", "/v1/reflect"])
def test_streams_hold_the_events_that_are_described(
    description: dict[str, Any], served: Served, path: str
) -> None:
    operation = description["paths"][path]["post"]
    one = operation["responses"]["200"]["content"]["text/event-stream"]["schema"]["properties"]
    (example,) = operation["requestBody"]["content"]["application/json"]["examples"].values()
    asked = example["value"] | {"stream": True}
    lines = served.http.post(path, json=asked).text.splitlines()
    told = {line.removeprefix("event: ") for line in lines if line.startswith("event: ")}
    assert {"branch", "trajectory", "done"} <= told <= set(one["event"]["enum"])


def test_fields_say_their_units(description: dict[str, Any]) -> None:
    schemas = description["components"]["schemas"]
    history = schemas["Scene"]["properties"]["history"]
    assert "10 Hz" in history["description"]
    assert "rad" in history["items"]["description"]
    assert "4 m" in str(schemas["Scene"]["properties"]["route"])
    assert schemas["PlanRequest"]["additionalProperties"] is False


def test_its_page_needs_nothing_from_elsewhere(served: Served) -> None:
    page = served.http.get("/docs")
    assert page.status_code == 200
    for source in re.findall(r'(?:src|href)="([^"]+)"', page.text):
        if not source.startswith("data:"):
            assert source.startswith("/docs/"), source
            assert served.http.get(source).status_code == 200
    assert "/openapi.json" in page.text
    assert "//cdn" not in page.text


def test_tags_and_servers_are_told_as_spectral_wants_them(description: dict[str, Any]) -> None:
    told = {tag["name"] for tag in description["tags"]}
    used = {
        tag
        for operations in description["paths"].values()
        for operation in operations.values()
        for tag in operation["tags"]
    }
    assert used == told
    assert description["servers"]
