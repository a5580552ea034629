"""POST /v1/score over a real socket: what it says, and what it refuses."""

from __future__ import annotations

import asyncio
import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import msgpack
import psutil
import pytest

from looktwice.clients.planner import AsyncPlannerClient, PlannerClient, PlannerProblem, RequestRefused
from looktwice.clients.wire_scores import ScoreRequest, ScoreResponse
from looktwice.service.operations.no_model import NoModel
from looktwice.service.operations.settings import Settings
from looktwice.service.routes.request_examples import example_score
from tests.service.http.test_problem_documents import problem
from tests.service.serving import Served, body, serve
from tests.waiting import until

SUB_SCORES = {
    *("no_at_fault_collisions", "drivable_area_compliance", "driving_direction_compliance"),
    *("traffic_light_compliance", "ego_progress", "time_to_collision", "lane_keeping", "comfort"),
    "extended_comfort",
}


@pytest.fixture(scope="module")
def scorer(scene_file: Path) -> Iterator[Served[NoModel]]:
    """A service without a model."""
    with serve(NoModel(), Settings(bundled_scenes=scene_file)) as running:
        yield running


def asked(**changes: Any) -> dict[str, Any]:
    return {**copy.deepcopy(example_score()), **changes}


def with_labels(**changes: Any) -> dict[str, Any]:
    return asked(labels={**example_score()["labels"], **changes})


def test_a_plan_that_brakes_is_worth_more_than_one_that_does_not(scorer: Served[NoModel]) -> None:
    told = scorer.http.post("/v1/score", json=asked(version="v1.1")).json()
    brakes, hits = told["scores"]
    assert (told["version"], told["against"], told["missing"]) == ("v1.1", "idm", [])
    assert brakes["score"] > 0.8
    assert brakes["failures"] == []
    assert hits["score"] == 0
    assert {"no_at_fault_collisions", "time_to_collision"} <= {each["sub_score"] for each in hits["failures"]}
    collision = next(each for each in hits["failures"] if each["sub_score"] == "no_at_fault_collisions")
    assert collision["other_id"] == "leader"
    # The leader's rear is at 27.75 m and drives off at 2 m/s, the ego's front is 4.05 m ahead of the axle.
    assert collision["time_s"] == pytest.approx((27.75 - 4.05) / 6, abs=0.2)
    assert collision["distance_m"] == 0
    warning = next(each for each in hits["failures"] if each["sub_score"] == "time_to_collision")
    assert warning["time_s"] < collision["time_s"]
    assert warning["distance_m"] > 0


def test_what_is_missing_is_null_and_the_score_only_partial(scorer: Served[NoModel]) -> None:
    told = scorer.http.post("/v1/score", json=asked()).json()
    assert told["missing"] == ["extended_comfort"]
    assert told["scores"][0]["score"] is None
    assert told["scores"][0]["partial_score"] > 0.8
    assert told["scores"][0]["sub_scores"].keys() == SUB_SCORES
    nothing = scorer.http.post("/v1/score", json=asked(labels={"ego": {"speed_mps": 8.0}})).json()
    assert set(nothing["missing"]) == SUB_SCORES
    assert nothing["scores"][0]["partial_score"] is None
    bare = {"ego": {"speed_mps": 8.0}, "agents": []}
    told = scorer.http.post("/v1/score", json=asked(labels=bare)).json()
    there = {name for name, value in told["scores"][0]["sub_scores"].items() if value is not None}
    assert there == {"no_at_fault_collisions", "time_to_collision"}
    assert set(told["missing"]) == SUB_SCORES - there
    assert told["against"] is None


def test_with_the_plan_before_it_nothing_is_missing(scorer: Served[NoModel]) -> None:
    previous = {"trajectory": asked()["trajectories"][0], "ego": {"speed_mps": 8.0}}
    told = scorer.http.post("/v1/score", json=asked(previous=previous)).json()
    assert told["missing"] == []
    assert told["scores"][0]["score"] == told["scores"][0]["partial_score"]


def test_a_bundled_scene_is_scored_against_its_expert(scorer: Served[NoModel]) -> None:
    scene = scorer.http.get("/v1/scenes/slow-leader").json()
    expert = [[x, y, heading] for x, y, _, heading in scene["future"]]
    told = scorer.http.post("/v1/score", json={"scene_id": "slow-leader", "trajectories": [expert]}).json()
    assert told["scores"][0]["sub_scores"]["no_at_fault_collisions"] == 1
    assert told["scores"][0]["score"] is None
    assert "traffic_light_compliance" in told["missing"]
    unknown = scorer.http.post("/v1/score", json={"scene_id": "none", "trajectories": [expert]})
    assert (unknown.status_code, unknown.json()["type"].rsplit("/")[-1]) == (404, "unknown-scene")


def test_four_thousand_plans_fit_into_one_body(scorer: Served[NoModel]) -> None:
    many = asked(trajectories=asked()["trajectories"] * 2048)
    content = msgpack.packb(many)
    headers = {"Content-Type": "application/msgpack", "Accept": "application/msgpack"}
    answer = scorer.http.post("/v1/score", content=content, headers=headers)
    told = msgpack.unpackb(answer.content)
    assert len(told["scores"]) == 4096
    assert told["scores"][4094] == told["scores"][0]


def test_each_scene_of_a_batch_gets_its_scores_or_its_problem(scorer: Served[NoModel]) -> None:
    wrong = asked(trajectories=[[[0.0, 0.0, 0.0]] * 9])
    told = scorer.http.post("/v1/score/batch", json={"requests": [asked(), wrong, {}]}).json()
    assert [each["status"] for each in told["results"]] == [200, 422, 422]
    assert told["results"][0]["response"]["against"] == "idm"
    assert told["results"][1]["problem"]["type"].endswith("/invalid-trajectory")


CROSSED = [[0.0, 0.0], [10.0, 10.0], [10.0, 0.0], [0.0, 10.0]]
GONE = {**example_score()["labels"]["agents"][0], "poses": [None] * 51}
SHORT = {**GONE, "poses": [[30.0, 0.0, 0.0]] * 45}


@pytest.mark.parametrize(
    ("request_body", "kind", "pointer"),
    [
        (asked(trajectories=[[[0.0, 0.0, 0.0]] * 9]), "invalid-trajectory", "/trajectories/0"),
        (asked(trajectories=[[[0.0] * 3] * 8, [[0.0] * 3] * 64]), "invalid-trajectory", "/trajectories/1"),
        (asked(trajectories=[[[0.0, 0.0, "nan"]] * 8]), "invalid-trajectory", "/trajectories/0/0/2"),
        (asked(reference=[[0.0, 0.0, 0.0]] * 20), "invalid-trajectory", "/reference"),
        (asked(trajectories=[[[9e4, 0.0, 0.0]] * 8]), "invalid-trajectory", "/trajectories"),
        (asked(vehicle={"width_m": 1e-9}), "invalid-labels", "/vehicle"),
        (
            with_labels(lanes=[{"lane_id": "a", "ring": CROSSED, "on_route": True}]),
            "invalid-labels",
            "/labels/lanes/0/ring",
        ),
        (with_labels(agents=[GONE]), "invalid-labels", "/labels/agents/0/poses"),
        (asked(version="v1.1", labels=with_labels(agents=[SHORT])["labels"]), "invalid-labels", "/labels"),
        (with_labels(centreline=[[1.0, 1.0], [1.0, 1.0]]), "invalid-labels", "/labels/centreline"),
        (with_labels(lane=[]), "unknown-field", "/labels/lane"),
        (asked(scene_id="slow-leader"), "invalid-request", ""),
    ],
)
def test_bad_input_gets_a_problem_that_says_where(
    scorer: Served[NoModel], request_body: dict[str, Any], kind: str, pointer: str
) -> None:
    answer = scorer.http.post("/v1/score", json=request_body)
    problem = answer.json()
    assert (answer.status_code, problem["type"].rsplit("/")[-1]) == (422, kind)
    assert problem["errors"][0]["pointer"].startswith(pointer)


def test_nan_is_no_number(scorer: Served[NoModel]) -> None:
    content = msgpack.packb(asked(trajectories=[[[0.0, float("nan"), 0.0]] * 8]))
    answer = scorer.http.post("/v1/score", content=content, headers={"Content-Type": "application/msgpack"})
    assert answer.json()["type"].endswith("/invalid-trajectory")


def test_both_clients_score_a_batch_and_one_scene_fails_alone(scorer: Served[NoModel]) -> None:
    good = ScoreRequest.model_validate(asked())
    wrong = good.model_copy(update={"trajectories": [[[0.0, 0.0, 0.0]] * 9]})

    async def asynchronously() -> list[ScoreResponse | PlannerProblem]:
        async with AsyncPlannerClient(scorer.url) as planner:
            return await planner.score_batch([good, wrong, good])

    with PlannerClient(scorer.url) as planner:
        alone = planner.score(good)
        told = planner.score_batch([good, wrong, good])
    for results in (told, asyncio.run(asynchronously())):
        first, second, third = results
        assert isinstance(second, RequestRefused)
        assert second.type.endswith("/invalid-trajectory")
        for each in (first, third):
            assert isinstance(each, ScoreResponse)
            assert each.scores == alone.scores


def test_the_described_batch_is_scored_by_both_versions(scorer: Served[NoModel]) -> None:
    operation = scorer.http.get("/openapi.json").json()["paths"]["/v1/score/batch"]["post"]
    (example,) = operation["requestBody"]["content"]["application/json"]["examples"].values()
    told = scorer.http.post("/v1/score/batch", json=example["value"]).json()["results"]
    assert [each["response"]["version"] for each in told] == ["v1.1", "v2.2"]
    assert [each["response"]["missing"] for each in told] == [[], ["extended_comfort"]]


def test_the_client_scores(scorer: Served[NoModel]) -> None:
    with PlannerClient(scorer.url) as planner:
        told = planner.score(ScoreRequest.model_validate(asked()))
    assert told.against == "idm"
    assert len(told.scores) == 2


def test_without_a_model_nothing_is_planned(scorer: Served[NoModel]) -> None:
    # A machine so busy that the event loop stood still is not ready for a moment, as it should be.
    until(lambda: scorer.http.get("/readyz").status_code == 200)
    assert scorer.http.get("/v1/models").json()["models"][0]["formats"] == []
    answer = scorer.http.post("/v1/plan", json=body())
    assert answer.status_code == 422
    assert "without a model" in answer.json()["detail"]


def test_of_thousands_of_wrong_trajectories_the_first_is_told(scorer: Served[NoModel]) -> None:
    wrong = [[["a", 0.0, 0.0]] * 8] * 3000
    refused = problem(scorer.http.post("/v1/score", json=asked(trajectories=wrong)), "invalid-trajectory")
    assert len(refused.errors) == 8
    assert "more)" not in refused.detail.replace("(and 7 more)", "")


def comb(sides: int, offset_m: float) -> list[list[float]]:
    """An outline whose sides all run beside each other, past every plan."""
    teeth = [
        [[offset_m + 0.4 * tooth, -50.0], [offset_m + 0.4 * tooth + 0.1, 50.0]] for tooth in range(sides // 2)
    ]
    way = [point for tooth, pair in enumerate(teeth) for point in (pair if tooth % 2 == 0 else pair[::-1])]
    return [*way[:-1], [offset_m + 0.2 * sides + 0.5, -60.0], [offset_m - 0.5, -60.0]]


def test_a_small_request_that_takes_gigabytes_to_score_harms_nobody(scorer: Served[NoModel]) -> None:
    lanes = [
        {"lane_id": str(lane), "ring": comb(120, 0.001 * lane - 20), "on_route": True} for lane in range(300)
    ]
    plans = example_score()["trajectories"] * 128
    refused = scorer.http.post("/v1/score", json={**with_labels(lanes=lanes), "trajectories": plans})
    assert "send fewer trajectories" in problem(refused, "invalid-labels").detail
    assert len(scorer.http.post("/v1/score", json=asked()).json()["scores"]) == 2


def test_who_leaves_ends_the_scoring(scorer: Served[NoModel]) -> None:
    """Nobody waits for a queue of scores that nobody wants."""
    lanes = [
        {"lane_id": str(lane), "ring": comb(60, 0.001 * lane - 6), "on_route": True} for lane in range(100)
    ]
    long = {**with_labels(lanes=lanes), "trajectories": example_score()["trajectories"] * 1000}
    assert scorer.http.post("/v1/score", json=asked()).status_code == 200
    for _ in range(3):
        with pytest.raises(httpx.ReadTimeout):
            scorer.http.post("/v1/score", json=long, timeout=httpx.Timeout(30.0, read=0.02))
    assert len(scorer.http.post("/v1/score", json=asked()).json()["scores"]) == 2
    scoring = [
        each
        for each in psutil.Process().children()
        if "looktwice.service.scoring.process" in " ".join(each.cmdline())
    ]
    assert len(scoring) == 1
