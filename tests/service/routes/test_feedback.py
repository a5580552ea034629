"""POST /v1/feedback over a real socket: what it says, who writes it, and what it refuses."""

from __future__ import annotations

import asyncio
import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import msgpack
import pytest

from looktwice.clients.labelling.teachers.openai import OpenAiSettings, OpenAiTeacher
from looktwice.clients.planner import AsyncPlannerClient, PlannerClient, RequestRefused
from looktwice.clients.wire_feedback import FeedbackRequest, FeedbackResponse
from looktwice.model.driving.pdm.feedback import Feedback, RuleFeedback, parse_feedback
from looktwice.service.operations.no_model import NoModel
from looktwice.service.operations.settings import Settings
from looktwice.service.routes.request_examples import example_feedback, example_score
from tests.clients.labelling.builds import ChatServer
from tests.service.http.test_problem_documents import problem
from tests.service.serving import Served, serve
from tests.sockets import listening

PATH = "/v1/feedback"


@pytest.fixture(scope="module")
def scorer(scene_file: Path) -> Iterator[Served[NoModel]]:
    """A service without a model."""
    with serve(NoModel(), Settings(bundled_scenes=scene_file)) as running:
        yield running


def asked(**changes: Any) -> dict[str, Any]:
    return {**copy.deepcopy(example_feedback()), **changes}


def given(scorer: Served[NoModel], **changes: Any) -> FeedbackResponse:
    answer = scorer.http.post(PATH, json=asked(**changes))
    assert answer.status_code == 200, answer.text
    return FeedbackResponse.model_validate(answer.json())


def test_the_wrong_plan_gets_five_sections_and_the_right_one_a_verdict(scorer: Served[NoModel]) -> None:
    told = given(scorer)
    assert (told.version, told.against, told.threshold) == ("v1.1", "ground_truth", 0.8)
    right, wrong = told.feedback
    assert right.correct
    assert right.sections is None
    assert isinstance(parse_feedback(right.text), RuleFeedback)
    assert (wrong.correct, wrong.score, wrong.judged_by, wrong.written_by) == (False, 0.0, "score", "rules")
    assert wrong.sections is not None
    assert parse_feedback(wrong.text) == Feedback(**wrong.sections.model_dump())
    hit = next(fact for fact in wrong.facts if fact.sub_score == "no_at_fault_collisions")
    assert hit.other is not None
    assert (hit.other.other_id, hit.other.kind, hit.other.gap_m) == ("leader", "vehicle", 0.0)
    assert hit.other.closing_mps == pytest.approx(6.0, abs=0.2)
    # The request's reasoning calls the road clear.
    assert "overlooks" in wrong.sections.think_process
    assert "#leader" in wrong.sections.safety_failure
    assert "to decelerate instead of to maintain speed" in wrong.sections.meta_action
    assert wrong.true_course is not None
    assert wrong.plan_id != right.plan_id


def test_scores_are_those_of_the_scorer(scorer: Served[NoModel]) -> None:
    body = {**example_score(), "version": "v1.1"}
    scores = scorer.http.post("/v1/score", json=body).json()["scores"]
    told = given(scorer, reference=body["reference"], against="idm")
    assert told.against == "idm"
    for score, feedback in zip(scores, told.feedback, strict=True):
        assert (score["score"], score["partial_score"]) == (feedback.score, feedback.partial_score)
        assert score["sub_scores"] == feedback.sub_scores
        for failure in score["failures"]:
            if score["sub_scores"][failure["sub_score"]] < 1:
                fact = next(each for each in feedback.facts if each.sub_score == failure["sub_score"])
                assert fact.time_s == failure["time_s"]
                assert (fact.other.other_id if fact.other else None) == failure["other_id"]


def test_a_collision_that_lanes_would_decide_is_judged_as_the_egos_own(scorer: Served[NoModel]) -> None:
    times_s = [0.1 * step for step in range(51)]
    closing_in = [[1.5 + 10 * time, max(3.5 - time, 1.9), 0.0] for time in times_s]
    agent = {"agent_id": "a", "kind": "vehicle", "length_m": 4.5, "width_m": 1.9, "poses": closing_in}
    labels = {"ego": {"speed_mps": 10.0}, "agents": [agent], "centreline": [[-20.0, 0.0], [160.0, 0.0]]}
    plans = [[[speed * 0.5 * step, 0.0, 0.0] for step in range(1, 9)] for speed in (10.0, 2.0)]
    body = {"labels": labels, "trajectories": plans}
    opened = scorer.http.post("/v1/score", json={**body, "version": "v1.1"}).json()["scores"]
    assert opened[0]["partial_score"] is None
    told = scorer.http.post(PATH, json={**body, "ground_truth": plans[0]})
    assert told.status_code == 200, told.text
    found = FeedbackResponse.model_validate(told.json())
    assert found.feedback[0].sub_scores["no_at_fault_collisions"] == 0.0
    assert not found.feedback[0].correct
    assert {fact.other.other_id for fact in found.feedback[0].facts if fact.other} == {"a"}


def test_the_threshold_decides_and_mode_rule_gives_verdicts_only(scorer: Served[NoModel]) -> None:
    score = given(scorer).feedback[0].score
    assert score is not None
    assert score < 1
    assert given(scorer, threshold=score).feedback[0].correct
    strict = given(scorer, threshold=1.0).feedback[0]
    assert not strict.correct
    assert strict.sections is not None
    assert all(each.correct for each in given(scorer, threshold=0.0).feedback)
    by_rule = given(scorer, mode="rule").feedback[1]
    assert by_rule.sections is None
    assert by_rule.text == (
        "The driving score is 0.0. The score is below the threshold, and the result is wrong. Please follow "
        "the prompts to regenerate the correct trajectory."
    )


def test_a_bundled_scene_brings_its_experts_future_and_its_score_is_partial(scorer: Served[NoModel]) -> None:
    scene = scorer.http.get("/v1/scenes/slow-leader").json()
    expert = [[x, y, heading] for x, y, _, heading in scene["future"]]
    stand = [[0.0, 0.0, 0.0]] * 64
    answer = scorer.http.post(PATH, json={"scene_id": "slow-leader", "trajectories": [expert, stand]})
    told = FeedbackResponse.model_validate(answer.json())
    assert told.against == "expert"
    first, second = told.feedback
    assert first.true_course is not None
    assert first.true_course.ahead_m == pytest.approx(first.course.ahead_m, abs=1e-3)
    assert second.true_course == first.true_course
    assert (second.judged_by, second.score) == ("score", second.partial_score)
    bare = {"labels": {"ego": {"speed_mps": 8.0}, "agents": []}, "trajectories": [stand]}
    partial = scorer.http.post(PATH, json=bare).json()["feedback"][0]
    assert (partial["judged_by"], partial["score"]) == ("partial_score", None)


def test_what_a_caller_has_had_written_is_checked_against_this_plan(scorer: Served[NoModel]) -> None:
    wrong = given(scorer).feedback[1]

    def written(text: str, plan_id: str | None = None) -> httpx.Response:
        said = [None, {"written": {"text": text, "plan_id": plan_id}}]
        return scorer.http.post(PATH, json=asked(said=said))

    own = str(Feedback("It keeps 8 m/s.", "It overlooks #leader.", "NC=0.", "EP is 0.0.", "Brake."))
    taken = FeedbackResponse.model_validate(written(own, wrong.plan_id).json()).feedback[1]
    assert (taken.text, taken.written_by) == (own, "caller")
    assert written(wrong.text).json()["feedback"][1]["text"] == wrong.text
    pointer = "/said/1/written"
    other = problem(written(own, "0" * 12), "other-plan")
    assert other.errors[0].pointer == f"{pointer}/plan_id"
    foreign = problem(written(own.replace("8 m/s", "9.9 m/s")), "other-plan")
    assert "9.9 m/s" in foreign.detail
    assert foreign.errors[0].pointer == f"{pointer}/text"
    problem(written("Brake."), "invalid-feedback")
    problem(written(str(RuleFeedback(0.0, correct=False))), "invalid-feedback")
    on_a_right_one = asked(said=[{"written": {"text": own}}, None])
    problem(scorer.http.post(PATH, json=on_a_right_one), "invalid-feedback")


GONE = {**example_score()["labels"]["agents"][0], "poses": [None] * 51}
POSE = [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("changes", "kind", "pointer"),
    [
        ({"trajectories": [[POSE] * 9] * 2}, "invalid-trajectory", "/trajectories/0"),
        ({"ground_truth": [POSE] * 20}, "invalid-trajectory", "/ground_truth"),
        ({"ground_truth": [[0.0, 0.0]] * 8}, "invalid-trajectory", "/ground_truth"),
        ({"threshold": 1.01}, "invalid-request", "/threshold"),
        ({"threshold": -0.01}, "invalid-request", "/threshold"),
        ({"said": [None]}, "invalid-request", ""),
        ({"said": [None, {"written": {"text": ""}}]}, "invalid-feedback", "/said/1/written/text"),
        ({"said": [None, {"written": {"text": "x"}}], "mode": "rule"}, "invalid-request", ""),
        ({"labels": {**example_score()["labels"], "agents": [GONE]}}, "invalid-labels", "/labels/agents/0"),
        ({"labels": {"ego": {"speed_mps": 8.0}}, "version": "v2.2"}, "invalid-labels", "/labels"),
        ({"trajectories": [[POSE] * 8] * 65, "said": None}, "invalid-trajectory", "/trajectories"),
        ({"scene_id": "slow-leader"}, "invalid-request", ""),
        ({"draft": []}, "unknown-field", "/draft"),
    ],
)
def test_bad_input_gets_a_problem_that_says_where(
    scorer: Served[NoModel], changes: dict[str, Any], kind: str, pointer: str
) -> None:
    told = problem(scorer.http.post(PATH, json=asked(**changes)), kind)
    assert told.errors[0].pointer.startswith(pointer)


@pytest.mark.parametrize("place", ["trajectories", "ground_truth", "threshold"])
def test_nan_is_no_number(scorer: Served[NoModel], place: str) -> None:
    nan = float("nan")
    wrong: Any = {"threshold": nan, "ground_truth": [[0.0, nan, 0.0]] * 8}.get(place, [[[nan] * 3] * 8] * 2)
    answer = scorer.http.post(
        PATH, content=msgpack.packb(asked(**{place: wrong})), headers={"Content-Type": "application/msgpack"}
    )
    problem(answer, "invalid-request" if place == "threshold" else "invalid-trajectory")


def test_both_clients_ask_for_feedback_and_it_is_counted(scorer: Served[NoModel]) -> None:
    request = FeedbackRequest.model_validate(asked())
    before = scorer.metric("looktwice_feedback_total", teacher="rules", verdict="wrong")
    with PlannerClient(scorer.url) as planner:
        told = planner.feedback(request)
        with pytest.raises(RequestRefused, match="9 poses"):
            planner.feedback(request.model_copy(update={"trajectories": [[[0.0] * 3] * 9] * 2}))

    async def asynchronously() -> FeedbackResponse:
        async with AsyncPlannerClient(scorer.url) as planner:
            return await planner.feedback(request)

    assert asyncio.run(asynchronously()).feedback == told.feedback
    assert scorer.metric("looktwice_feedback_total", teacher="rules", verdict="wrong") == before + 2


class Taught:
    """A service whose teacher is an endpoint that answers by a script."""

    def __init__(self, script: list[Any], scene_file: Path) -> None:
        self.server, self._scenes = ChatServer(script), scene_file

    def ask(self, **changes: Any) -> tuple[httpx.Response, Served[NoModel]]:
        with listening(self.server.app()) as (url, _):
            teacher = OpenAiTeacher(OpenAiSettings(f"{url}/v1", "some-vlm", temperature=0.2))
            with serve(NoModel(), Settings(bundled_scenes=self._scenes), teacher=teacher) as served:
                answer = served.http.post(PATH, json=asked(**changes))
                self.refused_checks = served.metric(
                    "looktwice_label_checks_failed_total", teacher="openai:some-vlm", check="number"
                )
                self.tokens = served.metric(
                    "looktwice_teacher_tokens_total", teacher="openai:some-vlm", direction="output"
                )
                return answer, served


TRUE = str(Feedback("It keeps 8.0 m/s.", "It overlooks #leader.", "NC=0.", "EP is 0.", "Brake at 4 s."))
MADE_UP = TRUE.replace("8.0 m/s", "9.9 m/s")


def test_an_endpoint_writes_the_sections_and_is_asked_again_for_numbers_that_are_no_facts(
    scene_file: Path,
) -> None:
    taught = Taught([MADE_UP, TRUE], scene_file)
    answer, _ = taught.ask()
    told = FeedbackResponse.model_validate(answer.json())
    right, wrong = told.feedback
    assert (wrong.text, wrong.written_by, wrong.attempts) == (TRUE, "openai:some-vlm", 2)
    assert (right.written_by, right.attempts) == ("rules", 0)
    assert (told.teacher.name, "feedback prompt" in told.teacher.revision) == ("openai:some-vlm", True)
    first, second = taught.server.asked
    prompt = first["messages"][1]["content"]
    for part in (
        "Command: go straight on",
        "Fault trajectory: [4.00, 0.00] at 0.5 s",
        "Ground truth trajectory",
    ):
        assert part in prompt
    assert "I keep my speed" in prompt
    assert first["max_tokens"] == 900
    assert "9.9 m/s is none of them" in second["messages"][1]["content"]
    assert (taught.refused_checks, taught.tokens) == (1, 100)


@pytest.mark.parametrize(
    ("script", "kind"),
    [
        ([MADE_UP], "feedback-refused"),
        (["Brake, please."], "feedback-refused"),
        ([(401, {})], "teacher-away"),
        ([(400, {})], "teacher-refused"),
    ],
)
def test_a_teacher_that_does_not_do_is_told_and_not_replaced(
    scene_file: Path, script: list[Any], kind: str
) -> None:
    answer, _ = Taught(script, scene_file).ask()
    assert json.loads(answer.content)["type"].endswith(kind)
    assert "told why" not in answer.text, "what an endpoint says stays in the log"


def test_nobody_is_asked_about_correct_plans_or_in_mode_rule(scene_file: Path) -> None:
    taught = Taught([TRUE], scene_file)
    assert taught.ask(mode="rule")[0].status_code == 200
    assert taught.ask(threshold=0.0)[0].status_code == 200
    assert taught.server.asked == []
