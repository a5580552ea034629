from __future__ import annotations

import json
import socket
from typing import Any

import numpy as np
import pytest

import looktwice.clients.wire as wire
from looktwice.clients.planner import PlannerClient, PlanResult, plan_request
from looktwice.clients.wire import PlanResponse
from looktwice.model.driving.images import ImageError
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene import SceneError
from looktwice.model.driving.trajectory import TEN_HZ_S
from looktwice.model.engines.engine import EngineError, RequestError
from tests.service.http.test_problem_documents import problem
from tests.service.scenes import scene
from tests.service.scripted_engine import KEEP_ON, REASONING, SLOW_DOWN, ScriptedEngine
from tests.service.serving import Served, body

STANDS = "- longitudinal\n  - 0.0s-6.4s: Wait\n- lateral\n  - 0.0s-6.4s: Left Turn\n"


def plan(served: Served, **controls: Any) -> PlanResponse:
    answer = served.http.post("/v1/plan", json=body(**controls))
    assert answer.status_code == 200, answer.text
    return PlanResponse.model_validate_json(answer.content)


def test_draws_come_in_order_with_all_their_parts(served: Served) -> None:
    response = plan(served, n=4, seed=3, thinking="always")
    assert [draw.index for draw in response.draws] == [0, 1, 2, 3]
    draw = response.draws[0]
    assert draw.plan is not None
    assert draw.revised_plan is not None
    assert draw.plan.text == str(KEEP_ON)
    assert draw.revised_plan.text == str(SLOW_DOWN)
    assert (draw.branch, draw.thinking) == ("Thinking:", REASONING)
    assert draw.tokens == {"plan": 40, "branch": 1, "thinking": 48, "revised_plan": 52, "trajectory": 8}
    lane = draw.revised_plan.tracks.lane
    assert lane is not None
    assert [(action.start_s, action.end_s, action.word) for action in lane] == [
        (0.0, 2.4, "Keep Lane"),
        (2.4, 6.4, "Left Lane Change"),
    ]
    assert response.model.name == "scripted"


def test_draws_say_whether_their_parts_agree(served: Served, engine: ScriptedEngine) -> None:
    looked = plan(served, n=4, thinking="always")
    given = plan(served, n=4, thinking="never", prefill=STANDS)
    for draw in looked.draws:
        assert draw.consistent is (draw.disagreements == [])
    # It stands still by its plan, and its trajectory drives on.
    assert {draw.consistent for draw in given.draws} == {False}
    assert [draw.disagreements for draw in given.draws] == [["plan_trajectory"]] * 4
    count = "looktwice_disagreements_total"
    told = sum("plan_trajectory" in draw.disagreements for draw in (*looked.draws, *given.draws))
    assert served.metric(count, parts="plan_trajectory", endpoint="plan") == told
    assert served.metric(count, parts="plan_trajectory", endpoint="reflect") == 0


def test_a_direct_draw_has_no_second_look(served: Served) -> None:
    draw = plan(served, n=1, thinking="never").draws[0]
    assert (draw.branch, draw.thinking, draw.revised_plan) == ("Action:", None, None)
    assert draw.think_probability is not None


def test_the_engine_gets_what_was_asked(served: Served, engine: ScriptedEngine) -> None:
    sent = scene("as-sent")
    document = body(
        sent, n=5, temperature=0.7, top_p=0.9, seed=11, think_threshold=0.25, deadline_ms=900, bind=True
    )
    assert served.http.post("/v1/plan", json=document).status_code == 200
    got = engine.submitted[0]
    assert got.scene.scene_id == "as-sent"
    assert got.scene.clips == sent.clips
    assert np.array_equal(got.scene.history, sent.history)
    assert sent.route is not None
    assert got.scene.route is not None
    assert np.array_equal(got.scene.route, sent.route)
    controls = got.controls
    assert (controls.n, controls.temperature, controls.top_p, controls.seed) == (5, 0.7, 0.9, 11)
    assert (controls.think_threshold, controls.thinking, controls.bind) == (0.25, "adaptive", True)
    # It counts from arrival, so some of it is gone.
    assert controls.deadline_ms is not None
    assert 1 <= controls.deadline_ms < 900


def test_log_probabilities_are_told_where_they_are_asked_for(served: Served) -> None:
    asked, given = wire.Controls(n=1, logprobs=True), wire.ReflectControls(n=1, logprobs=True)
    with PlannerClient(served.url) as planner:
        silent = planner.plan(scene(), wire.Controls(n=1))
        alone = planner.plan(scene(), asked)
        [batch] = planner.plan_batch([plan_request(scene(), asked)])
        events = dict(planner.stream(plan_request(scene(), asked)))
        looked = planner.reflect(scene(), KEEP_ON, given)
    assert silent.draws[0].logprobs is None
    assert isinstance(batch, PlanResult)
    assert isinstance(events["done"], PlanResult)
    for result in (alone, batch, events["done"], looked):
        assert result.draws[0].logprobs == wire.Logprobs(token_ids=[11, 12, 13], logprobs=[None, -0.25, -1.5])


def test_trajectories_are_told_with_times_of_their_own(served: Served, engine: ScriptedEngine) -> None:
    usual = plan(served, n=2, thinking="always").draws
    assert {draw.times_s for draw in usual} == {None}
    engine.times_s = (0.5, 1.0, 1.5, 2.0)
    try:
        with PlannerClient(served.url) as planner:
            asked = wire.Controls(n=2, seed=1, thinking="always", deadline_ms=60_000)
            result = planner.plan(scene(), asked)
            events = list(planner.stream(plan_request(scene(), asked)))
            looked = planner.reflect(scene(), KEEP_ON, wire.ReflectControls(n=2, seed=1))
    finally:
        engine.times_s = TEN_HZ_S
    for draw, other in zip(result.draws, usual, strict=True):
        assert draw.times_s == (0.5, 1.0, 1.5, 2.0)
        expected = np.array(other.trajectory)[[4, 9, 14, 19]]
        np.testing.assert_allclose(draw.trajectory, expected, atol=1e-3)
        assert draw.at_10_hz.shape == (20, 4)
        assert draw.draft_trajectory is not None
        assert draw.draft_trajectory.shape == (4, 4)
        # Nobody knows whether it follows a plan that goes on behind it.
        assert "plan_trajectory" not in draw.disagreements
    told = [event for name, event in events if isinstance(event, wire.TrajectoryWritten)]
    assert len(told) == 4
    assert all(event.times_s == [0.5, 1.0, 1.5, 2.0] for event in told)
    assert looked.draws[0].times_s == (0.5, 1.0, 1.5, 2.0)


def test_the_route_may_be_left_out(served: Served, engine: ScriptedEngine) -> None:
    document = body()
    del document["scene"]["route"], document["controls"]
    assert served.http.post("/v1/plan", json=document).status_code == 200
    assert engine.submitted[0].scene.route is None
    assert engine.submitted[0].controls.n == 6


def test_a_plan_that_came_back_can_be_sent_back(served: Served, engine: ScriptedEngine) -> None:
    revised = plan(served, n=1, thinking="always").draws[0].revised_plan
    assert revised is not None
    plan(served, prefill=revised.text)
    plan(served, prefill=revised.tracks.model_dump())
    assert [request.controls.prefill for request in engine.submitted] == [None, SLOW_DOWN, SLOW_DOWN]


def test_tracks_may_be_a_part_of_a_plan(served: Served, engine: ScriptedEngine) -> None:
    plan(served, prefill={"longitudinal": [{"start_s": 0, "end_s": 6.4, "word": "Wait"}]})
    assert engine.submitted[0].controls.prefill == parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")


@pytest.mark.parametrize(
    ("failure", "slug"),
    [
        (RequestError("too many draws for this engine"), "request-refused"),
        (SceneError("no clip"), "request-refused"),
        (ImageError("the picture is damaged"), "invalid-image"),
        (EngineError("decoding failed"), "engine-failed"),
    ],
)
def test_what_the_engine_says_is_passed_on(
    served: Served, engine: ScriptedEngine, failure: Exception, slug: str
) -> None:
    engine.failure = failure
    assert str(failure) in problem(served.http.post("/v1/plan", json=body()), slug).detail
    engine.failure = None
    assert served.http.post("/v1/plan", json=body()).status_code == 200


def test_a_failed_engine_may_be_tried_again(served: Served, engine: ScriptedEngine) -> None:
    engine.failure = EngineError("decoding failed")
    assert served.http.post("/v1/plan", json=body()).headers["Retry-After"] == "1"


def test_the_unforeseen_is_a_problem_that_tells_nothing(
    served: Served, engine: ScriptedEngine, capfd: pytest.CaptureFixture[str]
) -> None:
    engine.failure = ZeroDivisionError("inside knowledge")
    answer = served.http.post("/v1/plan", json=body(), headers={"X-Request-ID": "find-me"})
    assert "inside knowledge" not in problem(answer, "internal").detail
    logged = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    failed = next(line for line in logged if line["event"] == "request failed")
    assert failed["request_id"] == "find-me"
    assert "inside knowledge" in failed["exception"]
    assert served.metric("looktwice_requests_total", endpoint="/v1/plan", status="500") == 1


def test_a_caller_that_leaves_cancels_the_planning(served: Served, engine: ScriptedEngine) -> None:
    served.in_loop(engine.may_finish.clear)
    content = json.dumps(body()).encode()
    host, port = served.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as connection:
        head = "POST /v1/plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json"
        connection.sendall(f"{head}\r\nContent-Length: {len(content)}\r\n\r\n".encode() + content)
        served.until(lambda: len(engine.submitted) == 1)
        assert served.metric("looktwice_plans_in_flight") == 1
        assert engine.cancelled == []
    served.until(lambda: len(engine.cancelled) == 1)
    assert engine.cancelled == [engine.submitted[0].request_id]
    served.until(lambda: served.metric("looktwice_requests_total", status="499") == 1)
    assert served.metric("looktwice_plans_in_flight") == 0


def test_callers_with_the_same_request_id_do_not_meet_in_the_engine(
    served: Served, engine: ScriptedEngine
) -> None:
    for _ in range(2):
        served.http.post("/v1/plan", json=body(), headers={"X-Request-ID": "same"})
    first, second = engine.submitted
    assert first.request_id != second.request_id
