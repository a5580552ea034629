from __future__ import annotations

from typing import Any

import pytest

import clients.wire as wire
from service.settings import Settings
from tests.service.scenes import scene
from tests.service.scripted_engine import ScriptedEngine
from tests.service.serving import Served, body
from tests.service.test_errors import BOMB, problem


@pytest.fixture
def settings() -> Settings:
    return Settings(max_draws=8)


def ask(served: Served, *requests: Any) -> list[wire.BatchResult]:
    answer = served.http.post("/v1/plan/batch", json={"requests": list(requests)})
    assert answer.status_code == 200, answer.text
    return wire.BatchResponse.model_validate_json(answer.content).results


def test_a_batch_is_answered_as_its_requests_would_be(served: Served, engine: ScriptedEngine) -> None:
    requests = [body(scene(f"{number}"), n=2, seed=number) for number in range(10)]
    results = ask(served, *requests)
    assert {request.scene.scene_id for request in engine.submitted} == {f"{k}" for k in range(10)}
    for asked, result in zip(requests, results, strict=True):
        alone = served.http.post("/v1/plan", json=asked)
        assert result.status == 200
        assert result.response is not None
        assert result.response.draws == wire.PlanResponse.model_validate_json(alone.content).draws


def test_one_that_fails_leaves_the_others(served: Served) -> None:
    broken = body()
    broken["scene"]["clips"][0]["images"][0] = BOMB
    results = ask(served, body(n=1), broken, body(n=9), body(n=1) | {"format": "haiku"})
    assert [result.status for result in results] == [200, 422, 200, 422]
    assert results[1].problem is not None
    assert results[1].problem.type.endswith("invalid-image")
    assert results[3].problem is not None
    assert results[3].problem.type.endswith("unknown-format")


@pytest.mark.parametrize(
    ("requests", "slug", "pointer"),
    [
        ([], "invalid-request", "/requests"),
        ([body()] * 65, "invalid-request", "/requests"),
        ([body(), {}], "invalid-request", "/requests/1/scene"),
        ([body(), body(n=0)], "invalid-controls", "/requests/1/controls/n"),
        ([body() | {"stream": True}], "invalid-controls", "/requests/0/stream"),
    ],
    ids=["none", "too many", "no scene", "no draws", "a stream"],
)
def test_bad_batches(served: Served, engine: ScriptedEngine, requests: Any, slug: str, pointer: str) -> None:
    found = problem(served.http.post("/v1/plan/batch", json={"requests": requests}), slug)
    assert found.errors[0].pointer == pointer
    assert engine.submitted == []
