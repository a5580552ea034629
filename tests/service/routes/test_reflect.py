from __future__ import annotations

from typing import Any

import pytest

from looktwice.clients.wire import ReflectResponse
from looktwice.model.driving.plan import parse_plan
from tests.service.http.test_problem_documents import problem
from tests.service.scripted_engine import KEEP_ON, REASONING, SLOW_DOWN, ScriptedEngine
from tests.service.serving import Served, body

PATH = "/v1/reflect"


def asking(plan: Any = str(KEEP_ON), **controls: Any) -> dict[str, Any]:
    document = body(**controls)
    return {"scene": document["scene"], "plan": plan, "controls": document["controls"]}


def reflect(served: Served, plan: Any = str(KEEP_ON), **controls: Any) -> ReflectResponse:
    answer = served.http.post(PATH, json=asking(plan, **controls))
    assert answer.status_code == 200, answer.text
    return ReflectResponse.model_validate_json(answer.content)


def test_a_plan_that_is_revised_shows_what_changed(served: Served, engine: ScriptedEngine) -> None:
    response = reflect(served, n=3, thinking="always")
    assert engine.submitted[0].controls.prefill == KEEP_ON
    assert response.plan.text == str(KEEP_ON)
    assert 0 <= response.think_probability <= 1
    assert [draw.index for draw in response.draws] == [0, 1, 2]
    look = response.draws[0]
    assert (look.decision, look.thinking) == ("revise", REASONING)
    assert look.revised_plan is not None
    assert look.revised_plan.text == str(SLOW_DOWN)
    # Words agree for 0.9 s along, for 6.4 s across, and for 2.4 s of the lane: 97 of 2 x 192 - 97 bins.
    assert look.plan_iou == pytest.approx(97 / 287)
    told = [
        (change.group, change.start_s, change.end_s, change.proposed, change.revised)
        for change in look.changes
    ]
    assert told == [
        ("longitudinal", 0.9, 2.1, "Keep Speed", "Decelerate"),
        ("longitudinal", 2.1, 4.8, "Accelerate", "Decelerate"),
        ("longitudinal", 4.8, 6.4, "Accelerate", "Keep Speed"),
        ("lane", 2.4, 6.4, "Keep Lane", "Left Lane Change"),
    ]
    assert len(look.trajectory) == 64


def test_a_plan_that_is_kept_has_no_changes(served: Served) -> None:
    look = reflect(served, n=1, thinking="never").draws[0]
    assert (look.decision, look.thinking, look.revised_plan) == ("keep", None, None)
    assert (look.plan_iou, look.changes) == (1.0, [])


def test_thinking_without_another_plan_is_keeping_it(served: Served) -> None:
    look = reflect(served, str(SLOW_DOWN), n=1, thinking="always").draws[0]
    assert (look.decision, look.plan_iou, look.thinking) == ("keep", 1.0, REASONING)


def test_the_plan_may_come_as_tracks_and_be_a_part_of_one(served: Served, engine: ScriptedEngine) -> None:
    tracks = {"longitudinal": [{"start_s": 0, "end_s": 6.4, "word": "Wait"}]}
    look = reflect(served, tracks, n=1, thinking="always").draws[0]
    assert engine.submitted[0].controls.prefill == parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")
    assert [(change.group, change.proposed) for change in look.changes][-1] == ("lane", None)


@pytest.mark.parametrize(
    ("plan", "place"),
    [
        ("- longitudinal\n  - 0.0s-6.4s: Fly\n", (2, 16)),
        ("- longitudinal\n  - 0.0s-2.0s: Wait\n", (2, None)),
    ],
)
def test_a_plan_that_does_not_parse_is_told_with_its_place(
    served: Served, engine: ScriptedEngine, plan: str, place: tuple[int, int | None]
) -> None:
    fault = problem(served.http.post(PATH, json=asking(plan)), "invalid-plan").errors[0]
    assert fault.pointer == "/plan"
    assert fault.line == place[0]
    assert place[1] is None or fault.column == place[1]
    assert engine.submitted == []


def test_what_is_no_plan_at_all_is_refused(served: Served) -> None:
    assert problem(served.http.post(PATH, json=asking(7)), "invalid-plan").errors[0].pointer == "/plan"
    assert problem(served.http.post(PATH, json=asking({})), "invalid-plan").errors[0].pointer == "/plan"
    prefilled = asking(prefill=str(KEEP_ON))
    assert problem(served.http.post(PATH, json=prefilled), "unknown-field")


def test_looks_are_counted_apart_from_plans(served: Served) -> None:
    reflect(served, n=2, thinking="always")
    count = "looktwice_branches_total"
    assert served.metric(count, branch="think", thinking="always", endpoint="reflect") == 2
    assert served.metric("looktwice_revised_plan_iou_count", endpoint="reflect") == 2
