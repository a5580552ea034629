from __future__ import annotations

import json
from typing import Any, get_args

import pytest
from hypothesis import given
from pydantic import ValidationError

from looktwice.clients import wire
from looktwice.clients.wire_values import plan_of_tracks, wire_plan, wire_tracks
from looktwice.model.driving import plan, scene, tracks, trajectory
from looktwice.model.engines import engine
from looktwice.model.families.cf_vla import CF_VLA
from tests.model.driving.test_plan import plans
from tests.service.serving import body


def test_the_contract_speaks_the_words_of_the_model() -> None:
    assert get_args(wire.Camera) == scene.CAMERAS
    assert get_args(wire.Thinking) == get_args(engine.Thinking)
    assert get_args(wire.AgentKind) == scene.AGENT_KINDS
    assert get_args(wire.Light) == scene.LIGHTS
    assert CF_VLA.branch is not None
    assert get_args(wire.Branch) == (CF_VLA.branch.direct, CF_VLA.branch.reflecting)
    assert tuple(wire.Tracks.model_fields) == plan.GROUPS
    asked = wire.Controls()
    assert engine.Controls(**asked.model_dump()) == engine.Controls()


def test_shapes_are_those_of_the_model() -> None:
    properties = wire.Scene.model_json_schema()["properties"]
    assert properties["history"]["minItems"] == properties["history"]["maxItems"] == trajectory.HISTORY_STEPS
    route = properties["route"]["anyOf"][0]
    assert route["minItems"] == route["maxItems"] == trajectory.ROUTE_POINTS
    assert properties["tracks"]["anyOf"][0]["maxItems"] == tracks.MAX_TRACKS
    told = {"x_m": 1.0, "y_m": 2.0, "heading_rad": 0.1, "speed_ms": 3.0, "length_m": 4.0, "width_m": 2.0}
    track = tracks.Track(**told, kind="cone", lights=frozenset({"left", "right"}))
    [sent] = wire_tracks([track])
    assert tracks.Track(**sent.model_dump(exclude={"lights"}), lights=frozenset(sent.lights)) == track
    future = wire.LabelledScene.model_json_schema()["properties"]["future"]
    assert future["minItems"] == future["maxItems"] == trajectory.FUTURE_STEPS


def test_a_request_survives_json() -> None:
    asked = wire.PlanRequest.model_validate(body())
    assert wire.PlanRequest.model_validate_json(asked.model_dump_json()) == asked


@given(plans())
def test_a_plan_survives_in_both_its_forms(told: plan.Plan) -> None:
    sent = wire.Plan.model_validate_json(wire_plan(told).model_dump_json())
    assert plan_of_tracks(sent.tracks) == plan.parse_plan(sent.text) == told


def change(document: dict[str, Any], *path: Any, to: Any) -> dict[str, Any]:
    *parents, last = path
    node: Any = document
    for part in parents:
        node = node[part]
    node[last] = to
    return document


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("surprise",), 1),
        (("scene", "surprise"), 1),
        (("controls", "surprise"), 1),
        (("scene", "clips", 0, "surprise"), 1),
        (("scene", "clips", 0, "camera"), "rear_spoiler"),
        (("scene", "clips"), []),
        (("scene", "history", 3, 1), float("nan")),
        (("scene", "history", 3, 1), float("inf")),
        (("scene", "history", 3, 1), "1.0"),
        (("scene", "history", 3, 1), 10**400),
        (("scene", "route", 3), [1.0, 2.0, 3.0]),
        (("scene", "tracks"), [{"kind": "dragon"}]),
        (("controls", "n"), 0),
        (("controls", "n"), 65),
        (("controls", "n"), 2.0),
        (("controls", "temperature"), 2.1),
        (("controls", "top_p"), 0),
        (("controls", "seed"), -1),
        (("controls", "seed"), True),
        (("controls", "thinking"), "sometimes"),
        (("controls", "prefill"), {"longitudinal": [{"start_s": 0.0, "end_s": 6.4}]}),
        (("controls", "prefill"), ["Accelerate"]),
    ],
)
def test_strictness(path: tuple[Any, ...], value: Any) -> None:
    with pytest.raises(ValidationError):
        wire.PlanRequest.model_validate(change(body(), *path, to=value))


def test_answers_may_grow() -> None:
    problem = {"type": "t", "title": "t", "status": 418, "detail": "d", "request_id": "r", "new": 1}
    assert wire.Problem.model_validate_json(json.dumps(problem)).status == 418


def test_an_older_service_does_not_say_whether_parts_agree() -> None:
    trajectory = [[0.1 * step, 0.0, 0.0, 0.0] for step in range(64)]
    written = wire.TrajectoryWritten.model_validate({"index": 0, "trajectory": trajectory})
    assert (written.consistent, written.disagreements) == (None, [])


@pytest.mark.parametrize(
    ("poses", "times_s", "fits"),
    [(64, None, True), (8, None, False), (2, [0.5, 1.0], True), (64, [0.5], False)],
)
def test_a_trajectory_has_64_poses_or_its_own_times(
    poses: int, times_s: list[float] | None, fits: bool
) -> None:
    told = {"index": 0, "trajectory": [[0.0] * 4] * poses, "times_s": times_s}
    if fits:
        wire.TrajectoryWritten.model_validate(told)
        return
    with pytest.raises(ValidationError, match="poses"):
        wire.TrajectoryWritten.model_validate(told)
