from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from looktwice.clients.labelling.checks import FailedCheck, check_reflection
from looktwice.clients.labelling.teachers.teacher import Answer, Question, TeacherClosed, TeacherError
from looktwice.clients.wire import LabelResponse
from looktwice.model.driving.outcome import in_words
from looktwice.model.driving.plan import parse_plan
from looktwice.service.operations.settings import Settings
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import KEEP_ON, SLOW_DOWN, ScriptedEngine
from tests.service.serving import Served, body, serve

PATH = "/v1/label"


class Upstream:
    """A teacher somewhere else, with one thing to say or to raise."""

    name, revision = "upstream", "1"

    def __init__(self, says: str | Exception) -> None:
        self._says = says

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        if isinstance(self._says, Exception):
            raise self._says
        return Answer(self._says, 100, 20, 0.01)

    async def close(self) -> None:
        pass


def asking(served: Served, **changes: Any) -> dict[str, Any]:
    """A question about a bundled scene, annotations as the service itself gives them."""
    shown = served.http.get("/v1/scenes/slow-leader").json()
    return {
        "scene": shown["scene"],
        "predicted_plan": str(KEEP_ON),
        "expert_plan": str(SLOW_DOWN),
        "annotations": {"agents": shown["agents"], "lane_lines": shown["lane_lines"]},
    } | changes


def test_a_reflection_is_written_and_checked(served: Served) -> None:
    answer = served.http.post(PATH, json=asking(served))
    assert answer.status_code == 200, answer.text
    written = LabelResponse.model_validate_json(answer.content)
    assert check_reflection(written.reflection, KEEP_ON, SLOW_DOWN) == []
    assert (written.teacher.name, written.attempts, written.failed_checks) == ("rules", 1, [])
    again = LabelResponse.model_validate_json(served.http.post(PATH, json=asking(served)).content)
    assert again.reflection == written.reflection
    assert served.metric("looktwice_labels_total", teacher="rules") == 2


def test_the_lights_of_others_reach_the_teacher(served: Served) -> None:
    asked = asking(served)
    assert "braking" not in served.http.post(PATH, json=asked).json()["reflection"]
    for agent in asked["annotations"]["agents"]:
        agent["lights"] = ["brake"]
    assert "A braking vehicle" in served.http.post(PATH, json=asked).json()["reflection"]


def test_without_annotations_the_built_in_teacher_says_what_it_lacks(served: Served) -> None:
    for lacking in (asking(served, annotations=None), {**asking(served)}):
        lacking.pop("annotations")
        assert "annotations" in problem(served.http.post(PATH, json=lacking), "needs-annotations").detail


@pytest.mark.parametrize("which", ["predicted_plan", "expert_plan"])
def test_a_plan_that_does_not_parse_is_told_with_its_place(served: Served, which: str) -> None:
    document = asking(served, **{which: "- longitudinal\n  - 0.0s-6.4s: Fly\n"})
    fault = problem(served.http.post(PATH, json=document), "invalid-plan").errors[0]
    assert (fault.pointer, fault.line) == (f"/{which}", 2)
    assert problem(served.http.post(PATH, json=asking(served, **{which: 3})), "invalid-plan")


def test_annotations_are_checked(served: Served) -> None:
    document = asking(served)
    document["annotations"]["agents"][0]["kind"] = "dragon"
    fault = problem(served.http.post(PATH, json=document), "invalid-request").errors[0]
    assert fault.pointer == "/annotations/agents/0/kind"
    document = asking(served)
    document["annotations"]["agents"][0]["poses"].pop()
    assert problem(served.http.post(PATH, json=document), "invalid-request")


@pytest.mark.parametrize(
    "change", [{"width_m": 99.0}, {"poses": [[90.0 * step, 0, 0] for step in range(80)]}]
)
def test_agents_that_no_road_user_can_be_are_told(served: Served, change: dict[str, Any]) -> None:
    document = asking(served)
    document["annotations"]["agents"][0] |= change
    fault = problem(served.http.post(PATH, json=document), "invalid-request").errors[0]
    assert fault.pointer == "/annotations/agents/0"


class Listening(Upstream):
    """Notes what it is asked."""

    def __init__(self) -> None:
        super().__init__("The lead vehicle ahead is slow, so the car should slow down.")
        self.asked: list[Question] = []

    async def reflect(self, question: Question, complaints: Sequence[FailedCheck] = ()) -> Answer:
        self.asked.append(question)
        return await super().reflect(question, complaints)


OUTCOMES = (
    {"fails": ["collision"], "collided_s": 2.1, "hit": "obstacle"},
    {"fails": ["off_road", "behind"], "off_road_s": 1.4, "driven_m": 12.0, "expert_m": 30.0},
    {"fails": ["comfort"], "uncomfortable_s": 0.3, "uncomfortable": "longitudinal_jerk"},
)
IN_WORDS = (
    "collides with an obstacle after 2.1 s",
    "leaves the road after 1.4 s, falls behind by 18 m",
    "has too much longitudinal jerk after 0.3 s",
)


def test_what_the_plan_failed_at_reaches_the_teacher(settings: Settings) -> None:
    teacher = Listening()
    with serve(ScriptedEngine(), settings, teacher=teacher) as served:
        served.http.post(PATH, json=asking(served))
        assert teacher.asked[-1].outcome is None
        for outcome, words in zip(OUTCOMES, IN_WORDS, strict=True):
            served.http.post(PATH, json=asking(served, outcome=outcome))
            given = teacher.asked[-1].outcome
            assert given is not None
            assert in_words(given) == words


@pytest.mark.parametrize(
    ("outcome", "pointer"),
    [
        ({"fails": []}, "/outcome/fails"),
        ({"fails": ["boredom"]}, "/outcome/fails/0"),
        ({"fails": ["collision"], "collided_s": 1.0}, "/outcome/hit"),
        ({"fails": ["off_route"]}, "/outcome/off_route_s"),
        ({"fails": ["behind"], "driven_m": 30.0, "expert_m": 12.0}, "/outcome/driven_m"),
        ({"fails": ["off_road"], "off_road_s": -1}, "/outcome/off_road_s"),
    ],
)
def test_an_outcome_is_checked(served: Served, outcome: dict[str, Any], pointer: str) -> None:
    document = asking(served, outcome=outcome)
    fault = problem(served.http.post(PATH, json=document), "invalid-request").errors[0]
    assert fault.pointer == pointer


def test_plans_that_agree_get_a_reflection_too(served: Served) -> None:
    plan = str(KEEP_ON)
    answer = served.http.post(PATH, json=asking(served, predicted_plan=plan, expert_plan=plan))
    assert answer.status_code == 200
    assert check_reflection(answer.json()["reflection"], parse_plan(plan), parse_plan(plan)) == []


def test_the_scene_is_checked_like_any_other(served: Served) -> None:
    document = asking(served)
    document["scene"]["clips"][0]["images"][0] = body()["scene"]["clips"][0]["images"][0][:-40] + "!"
    assert problem(served.http.post(PATH, json=document), "invalid-image")


@pytest.mark.parametrize(
    ("error", "type", "status"),
    [
        (TeacherError("400: too many pictures"), "teacher-refused", 502),
        (TeacherClosed("401: no such key"), "teacher-away", 503),
    ],
)
def test_an_upstream_teacher_that_fails_is_told_from_a_question_that_lacks_something(
    settings: Settings, error: Exception, type: str, status: int
) -> None:
    with serve(ScriptedEngine(), settings, teacher=Upstream(error)) as served:
        answer = served.http.post(PATH, json=asking(served))
        assert answer.status_code == status
        assert str(error) not in problem(answer, type).detail, "what an upstream says stays in the log"


def test_checks_that_a_teacher_never_passes_are_counted_by_reason(settings: Settings) -> None:
    with serve(ScriptedEngine(), settings, teacher=Upstream("The expert brakes for the van.")) as served:
        answer = served.http.post(PATH, json=asking(served))
        assert "'expert'" in problem(answer, "label-refused").detail
        for check, failed in (("leak", 3), ("length", 0)):
            labels = {"teacher": "upstream", "check": check}
            assert served.metric("looktwice_label_checks_failed_total", **labels) == failed
        assert served.metric("looktwice_labels_total", teacher="upstream") == 0
        paid = {"teacher": "upstream", "direction": "input"}
        assert served.metric("looktwice_teacher_tokens_total", **paid) == 3 * 100
