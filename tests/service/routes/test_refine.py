"""Attempts and POST /v1/refine over a real socket, with an untrained checkpoint that refines."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from pydantic import BaseModel

import looktwice.clients.wire as wire
from looktwice.clients.planner import (
    AsyncPlannerClient,
    PlannerClient,
    RequestRefused,
    attempt_at,
    refine_request,
)
from looktwice.clients.wire_feedback import FeedbackRequest, FeedbackSections
from looktwice.clients.wire_refine import DraftJudged, RefineRequest, RefineResponse, SectionsGiven
from looktwice.model.driving.pdm.feedback import Feedback, parse_feedback
from looktwice.model.driving.scene import Track
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.network.vla_settings import VlaSettings
from looktwice.service.operations.no_model import NoModel
from looktwice.service.operations.settings import Settings
from looktwice.service.routes.request_examples import example_refinement, example_score
from tests.checkpoints import write_untrained
from tests.service.http.test_problem_documents import problem
from tests.service.scenes import scene
from tests.service.scripted_engine import CARD, ScriptedEngine
from tests.service.serving import Served, serve

PATH = "/v1/refine"
FORMATS = ("elf_vla", "elf_vla_refine")
HALF_SECONDS = tuple(0.5 * step for step in range(1, 9))
DRAFT = np.array([[12.0 * time_s, 0.0, 0.0, 0.0] for time_s in HALF_SECONDS], np.float32)
"""Keeps its 12 m/s."""
LEADER = Track(25.0, 0.0, 0.0, 3.0, 4.5, 1.9, "vehicle")
BEHIND_LEADER = replace(scene(), tracks=(LEADER,))
CAMERAS = ("front_wide_120", "front_tele_30")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served[TorchEngine]]:
    settings = VlaSettings(name="elf", formats=FORMATS, reflection="phrases")
    folder = write_untrained(tmp_path_factory.mktemp("elf") / "checkpoint", narrow=True, settings=settings)
    engine = TorchEngine(folder, TorchSettings(rows=4, products=None))
    with serve(engine, Settings()) as running:
        yield running


def asked(**changes: Any) -> dict[str, Any]:
    return {**example_refinement(CAMERAS), **changes}


def refined(served: Served[Any], request: RefineRequest | dict[str, Any]) -> RefineResponse:
    document = request if isinstance(request, dict) else request.model_dump()
    answer = served.http.post(PATH, json=document)
    assert answer.status_code == 200, answer.text
    return RefineResponse.model_validate_json(answer.content)


def test_a_draw_and_feedback_on_it_are_planned_again(served: Served[TorchEngine]) -> None:
    controls = wire.Controls(n=1, seed=3, logprobs=True)
    with PlannerClient(served.url) as planner:
        assert [card.refines for card in planner.models()] == [["elf_vla_refine"]]
        first = planner.plan(scene(), controls, format="elf_vla").draws[0]
        told = [
            planner.plan(
                scene(),
                controls,
                format="elf_vla_refine",
                attempt=attempt_at(first.trajectory, feedback, first.times_s),
            ).draws[0]
            for feedback in ("The driving score is 0.0.", "Brake.", "<feedback>\nBrake.\n</feedback>")
        ]
        with pytest.raises(RequestRefused, match="elf_vla refines none") as caught:
            planner.plan(scene(), controls, attempt=attempt_at(DRAFT, "Brake.", HALF_SECONDS))
        assert caught.value.errors[0].pointer == "/attempt"
        with pytest.raises(RequestRefused, match="refines an attempt, and there is none"):
            planner.plan(scene(), controls, format="elf_vla_refine")
        with pytest.raises(RequestRefused, match="at most 1024 are allowed"):
            planner.plan(
                scene(),
                controls,
                format="elf_vla_refine",
                attempt=attempt_at(DRAFT, "Z " * 2000, HALF_SECONDS),
            )
    # What is said of it changes what comes of it; tags around it do not.
    assert told[0].logprobs != told[1].logprobs
    assert told[1].logprobs == told[2].logprobs

    async def asynchronously() -> wire.Logprobs | None:
        attempt = attempt_at(first.trajectory, "Brake.", first.times_s)
        async with AsyncPlannerClient(served.url) as planner:
            result = await planner.plan(scene(), controls, format="elf_vla_refine", attempt=attempt)
        return result.draws[0].logprobs

    assert asyncio.run(asynchronously()) == told[1].logprobs


def test_a_stream_tells_of_the_draft_first(served: Served[TorchEngine]) -> None:
    request = refine_request(BEHIND_LEADER, DRAFT, controls=wire.ReflectControls(n=2, seed=4))
    plain = refined(served, request)
    with PlannerClient(served.url) as planner:
        events = list(planner.stream_refine(request))
    (first, judged), *told, (last, done) = events
    assert (first, last) == ("feedback", "done")
    assert isinstance(judged, DraftJudged)
    assert isinstance(done, RefineResponse)
    assert {name for name, _ in told} == {"thinking", "trajectory"}
    assert judged.model_dump() == plain.model_dump(include=set(DraftJudged.model_fields))
    assert (done.draws, done.before) == (plain.draws, plain.before)
    for draw in plain.draws:
        words = [data.text for _, data in told if isinstance(data, wire.ThinkingWritten)]
        poses = [data.trajectory for _, data in told if isinstance(data, wire.TrajectoryWritten)]
        assert draw.thinking in words
        assert draw.trajectory in poses

    async def asynchronously() -> list[str]:
        async with AsyncPlannerClient(served.url) as planner:
            return [name async for name, _ in planner.stream_refine(request)]

    assert asyncio.run(asynchronously())[0] == "feedback"


def test_a_key_gets_the_answer_that_was_made() -> None:
    engine = ScriptedEngine()
    engine.card_shown, engine.times_s = replace(CARD, formats=FORMATS), HALF_SECONDS
    key = {"Idempotency-Key": "draft-1"}
    with serve(engine, Settings()) as served:
        first = served.http.post(PATH, json=asked(), headers=key)
        again = served.http.post(PATH, json=asked(), headers=key)
        assert (again.status_code, again.content) == (200, first.content)
        assert again.headers["Idempotency-Replayed"] == "true"
        assert len(engine.submitted) == 1
        problem(served.http.post(PATH, json=asked(threshold=0.5), headers=key), "idempotency-key-reused")
        problem(served.http.post(PATH, json=asked(stream=True), headers=key), "invalid-request")
        # Where drafts are judged, and made again, history is the same, checked once.
        history = [[0.0] * 4] * 15 + [[9.0] * 4]
        changed = asked()["scene"] | {"history": history}
        told = problem(served.http.post(PATH, json=asked(scene=changed)), "invalid-history")
        assert told.errors[0].pointer == "/scene/history"


def test_a_failing_draft_is_told_why_and_refined(served: Served[TorchEngine]) -> None:
    told = refined(served, refine_request(BEHIND_LEADER, DRAFT, controls=wire.ReflectControls(n=3)))
    assert (told.format, told.foresight, told.version) == ("elf_vla_refine", "constant_velocity", "v1.1")
    assert (told.feedback.written_by, told.feedback.correct) == ("rules", False)
    feedback = parse_feedback(told.feedback.text)
    assert isinstance(feedback, Feedback)
    assert "No ground truth is known" in feedback.meta_action
    assert "hits the vehicle #0, closing in at 9.0 m/s" in feedback.safety_failure
    assert told.before is not None
    assert (told.before.score, told.before.partial_score) == (None, 0.0)
    # 25 m between the centres, 4.5 m of cars, 9 m/s.
    hit = next(each for each in told.before.failures if each.sub_score == "no_at_fault_collisions")
    assert hit.other_id == "0"
    assert hit.time_s == pytest.approx((25 - 4.5) / 9, abs=0.2)
    assert told.missing == ["drivable_area_compliance", "ego_progress"]
    assert [draw.index for draw in told.draws] == [0, 1, 2]
    for draw in told.draws:
        assert draw.times_s == list(HALF_SECONDS)
        assert draw.thinking
        assert draw.after is not None
        assert draw.after.score is None
        assert draw.after.partial_score is not None


def test_what_is_told_after_is_what_the_same_trajectory_is_told_before(served: Served[TorchEngine]) -> None:
    first = refined(served, refine_request(BEHIND_LEADER, DRAFT, controls=wire.ReflectControls(n=1)))
    (draw,) = first.draws
    again = refined(
        served,
        refine_request(
            BEHIND_LEADER, np.array(draw.trajectory, np.float32), "Again.", wire.ReflectControls(n=1)
        ),
    )
    assert draw.after is not None
    assert again.before == draw.after


def test_the_draft_may_come_at_10_hz_and_is_told_alike(served: Served[TorchEngine]) -> None:
    fine = np.zeros((64, 4), np.float32)
    fine[:, 0] = 1.2 * np.arange(1, 65)
    controls = wire.ReflectControls(n=1)
    coarse, finer = (
        refined(served, refine_request(BEHIND_LEADER, draft, controls=controls)) for draft in (DRAFT, fine)
    )
    assert coarse.before is not None
    assert finer.before is not None
    assert coarse.before.sub_scores == finer.before.sub_scores
    assert coarse.draws[0].trajectory == finer.draws[0].trajectory


def test_a_right_draft_is_told_so_and_the_threshold_decides(served: Served[TorchEngine]) -> None:
    slow = 0.25 * DRAFT
    free = replace(BEHIND_LEADER, tracks=())
    controls = wire.ReflectControls(n=1)
    told = refined(served, refine_request(free, DRAFT, controls=controls))
    assert told.feedback.correct
    assert told.feedback.text.endswith("The score is not below the threshold, and the result is right.")
    assert told.before is not None
    assert told.before.partial_score == 1.0
    rough = refined(served, refine_request(free, slow, controls=controls))
    assert rough.before is not None
    assert rough.before.sub_scores["comfort"] == 0.0
    lenient = refined(served, refine_request(free, slow, controls=controls, threshold=0.0))
    assert (rough.feedback.correct, lenient.feedback.correct) == (False, True)


def test_a_touch_beside_the_ego_is_its_fault_where_no_lanes_are_known(served: Served[TorchEngine]) -> None:
    beside = replace(BEHIND_LEADER, tracks=(Track(1.0, 2.5, 0.0, 12.0, 4.5, 1.9, "vehicle"),))
    draft = DRAFT.copy()
    draft[:, 1] = np.minimum(0.4 * np.arange(1, 9), 2.0)
    told = refined(served, refine_request(beside, draft, controls=wire.ReflectControls(n=1)))
    assert told.before is not None
    assert told.before.sub_scores["no_at_fault_collisions"] == 0.0
    assert "the vehicle #0" in told.feedback.text


def test_the_caller_may_write_words_or_sections(served: Served[TorchEngine]) -> None:
    controls = wire.ReflectControls(n=1, logprobs=True)
    words = refined(served, refine_request(BEHIND_LEADER, DRAFT, "Brake.", controls))
    assert (words.feedback.text, words.feedback.written_by, words.feedback.correct) == (
        "Brake.",
        "caller",
        None,
    )
    assert words.before is not None
    sections = SectionsGiven(
        meta_action="It keeps 12 m/s.",
        think_process="None.",
        safety_failure="It hits the leader.",
        efficiency_failure="None.",
        correction="Brake.",
    )
    told = refined(served, refine_request(BEHIND_LEADER, DRAFT, sections, controls))
    assert parse_feedback(told.feedback.text) == Feedback(**sections.model_dump(exclude={"plan_id"}))
    assert told.draws[0].logprobs != words.draws[0].logprobs


def test_feedback_that_names_its_plan_is_taken_for_that_plan_alone(served: Served[TorchEngine]) -> None:
    """Judged by POST /v1/feedback first, poses with x, y and heading; then refined."""
    poses = [[x, y, heading] for x, y, _, heading in DRAFT.tolist()]
    judged = FeedbackRequest.model_validate(example_score() | {"trajectories": [poses], "version": "v1.1"})
    controls = wire.ReflectControls(n=1)
    with PlannerClient(served.url) as planner:
        (told,) = planner.feedback(judged).feedback
        assert told.sections is not None
        sections = SectionsGiven(**told.sections.model_dump(), plan_id=told.plan_id)
        assert planner.refine(refine_request(scene(), DRAFT, sections, controls)).feedback.text == told.text
        other = DRAFT + np.array([0.0, 0.1, 0.0, 0.0], np.float32)
        with pytest.raises(RequestRefused, match="this draft is") as caught:
            planner.refine(refine_request(scene(), other, sections, controls))
    assert caught.value.type.endswith("/other-plan")
    assert caught.value.errors[0].pointer == "/feedback/plan_id"


def test_the_described_examples_are_refined(served: Served[TorchEngine]) -> None:
    operation = served.http.get("/openapi.json").json()["paths"][PATH]["post"]
    examples = operation["requestBody"]["content"]["application/json"]["examples"].values()
    written_by = []
    for example in examples:
        told = refined(served, example["value"] | {"stream": False})
        written_by.append(told.feedback.written_by)
    assert written_by == ["rules", "rules", "caller"]


def test_without_tracks_nothing_is_scored_and_the_caller_has_to_write(served: Served[TorchEngine]) -> None:
    untracked = refine_request(scene(), DRAFT, "Brake.", wire.ReflectControls(n=1))
    told = refined(served, untracked)
    assert (told.foresight, told.before, told.missing) == (None, None, [])
    assert [draw.after for draw in told.draws] == [None]
    auto = untracked.model_copy(update={"feedback": "auto"})
    found = problem(served.http.post(PATH, json=auto.model_dump()), "needs-tracks")
    assert found.errors[0].pointer == "/scene/tracks"


def test_both_clients_ask_for_the_example_and_it_is_counted(served: Served[TorchEngine]) -> None:
    before = served.metric("looktwice_feedback_total", teacher="rules", verdict="wrong")
    request = RefineRequest.model_validate(asked())

    async def asynchronously() -> RefineResponse:
        async with AsyncPlannerClient(served.url) as planner:
            return await planner.refine(request)

    with PlannerClient(served.url) as planner:
        told = planner.refine(request)
    assert asyncio.run(asynchronously()).draws == told.draws
    assert len(told.draws) == 2
    assert served.metric("looktwice_feedback_total", teacher="rules", verdict="wrong") == before + 2
    packed = served.http.post(
        PATH,
        content=msgpack.packb(asked()),
        headers={"Content-Type": "application/msgpack", "Accept": "application/msgpack"},
    )
    assert msgpack.unpackb(packed.content)["draws"] == told.model_dump()["draws"]


POSE = [0.0, 0.0, 0.0, 0.0]
TRACK = example_refinement(CAMERAS)["scene"]["tracks"][0]
SECTIONS = dict.fromkeys(FeedbackSections.model_fields, "Brake.")


@pytest.mark.parametrize(
    ("changes", "kind", "pointer"),
    [
        ({"draft": [POSE] * 9}, "invalid-trajectory", "/draft"),
        ({"draft": [POSE] * 65}, "invalid-trajectory", "/draft"),
        ({"draft": [POSE[:3]] * 8}, "invalid-trajectory", "/draft/0"),
        ({"draft": [[2000.0, 0.0, 0.0, 0.0]] * 8}, "invalid-trajectory", "/draft"),
        ({"draft": None}, "invalid-trajectory", "/draft"),
        ({"feedback": ""}, "invalid-feedback", "/feedback"),
        ({"feedback": "x" * 4001}, "invalid-feedback", "/feedback"),
        ({"feedback": {"meta_action": "Brake."}}, "invalid-feedback", "/feedback/think_process"),
        ({"feedback": SECTIONS | {"correction": "x" * 701}}, "invalid-feedback", "/feedback/correction"),
        ({"feedback": SECTIONS | {"correction": "a\nb"}}, "invalid-feedback", "/feedback"),
        ({"feedback": SECTIONS | {"said": "x"}}, "unknown-field", "/feedback/said"),
        ({"feedback": SECTIONS | {"plan_id": "0" * 12}}, "other-plan", "/feedback/plan_id"),
        ({"feedback": SECTIONS | {"plan_id": "that one"}}, "invalid-feedback", "/feedback/plan_id"),
        ({"feedback": "Brake.</feedback>"}, "request-refused", None),
        ({"feedback": "Z " * 1900}, "request-refused", None),
        ({"threshold": 1.01}, "invalid-request", "/threshold"),
        ({"controls": {"n": 0}}, "invalid-controls", "/controls/n"),
        ({"controls": {"prefill": "x"}}, "unknown-field", "/controls/prefill"),
        ({"controls": {"thinking": "never"}}, "invalid-controls", "/controls/thinking"),
        ({"controls": {"think_threshold": 0.5}}, "invalid-controls", "/controls/think_threshold"),
        (
            {"scene": asked()["scene"] | {"tracks": [TRACK | {"speed_ms": 151.0}]}},
            "invalid-tracks",
            "/scene/tracks/0",
        ),
        (
            {"scene": asked()["scene"] | {"tracks": [TRACK, TRACK | {"width_m": 1e-300}]}},
            "invalid-tracks",
            "/scene/tracks/1",
        ),
    ],
)
def test_bad_input_gets_a_problem_that_says_where(
    served: Served[TorchEngine], changes: dict[str, Any], kind: str, pointer: str | None
) -> None:
    told = problem(served.http.post(PATH, json=asked(**changes)), kind)
    assert (told.errors[0].pointer if told.errors else None) == pointer


@pytest.mark.parametrize("pack", [msgpack.packb, lambda document: json.dumps(document).encode()])
def test_nan_is_no_number(served: Served[TorchEngine], pack: Any) -> None:
    media = "application/msgpack" if pack is msgpack.packb else "application/json"
    content = pack(asked(draft=[[0.0, float("nan"), 0.0, 0.0]] * 8))
    answer = served.http.post(PATH, content=content, headers={"Content-Type": media})
    assert problem(answer, "invalid-trajectory").errors[0].pointer == "/draft/0/1"


@pytest.mark.parametrize(
    "field", ["ground_truth", "reference", "human", "labels", "scene_id", "future", "expert", "format"]
)
def test_ground_truth_has_no_place(served: Served[TorchEngine], field: str) -> None:
    problem(served.http.post(PATH, json=asked(**{field: [POSE] * 8})), "unknown-field")
    within = asked()["scene"] | {field: [POSE] * 8}
    if field != "scene_id":
        problem(served.http.post(PATH, json=asked(scene=within)), "unknown-field")


def test_no_type_of_a_request_holds_what_comes() -> None:
    def fields(model: type[BaseModel]) -> set[str]:
        schema = json.dumps(model.model_json_schema())
        return {
            name for name in ("future", "agents", "poses", "ground_truth", "expert") if f'"{name}"' in schema
        }

    assert fields(RefineRequest) == set()
    assert "agents" in fields(wire.LabelRequest)


def test_a_checkpoint_without_a_refining_format_is_refused_by_name(scene_file: Path) -> None:
    with serve(ScriptedEngine(), Settings(bundled_scenes=scene_file)) as plain:
        told = problem(plain.http.post(PATH, json=asked()), "unknown-format")
        assert told.detail.startswith("scripted refines no drafts: it writes cf_vla, traj_only")
        assert plain.engine.submitted == []
    with serve(NoModel(), Settings(bundled_scenes=scene_file)) as nobody:
        assert "without a model" in problem(nobody.http.post(PATH, json=asked()), "unknown-format").detail


def scripted(inputs: tuple[str, ...]) -> ScriptedEngine:
    engine = ScriptedEngine()
    engine.card_shown = replace(CARD, formats=("cf_vla", "elf_vla_refine"), inputs=inputs)
    return engine


@pytest.mark.parametrize("takes_tracks", [True, False])
def test_the_model_sees_tracks_where_it_takes_them(*, takes_tracks: bool) -> None:
    with serve(scripted(("route", "tracks") if takes_tracks else ("route",)), Settings()) as running:
        told = refined(running, refine_request(BEHIND_LEADER, DRAFT))
        (submitted,) = running.engine.submitted
    assert submitted.format == "elf_vla_refine"
    assert submitted.scene.tracks == ((LEADER,) if takes_tracks else None)
    assert submitted.attempt is not None
    assert submitted.attempt.feedback == told.feedback.text
    assert (submitted.attempt.trajectory == DRAFT).all()
    # Its poses come at 10 Hz, and are scored at 2 Hz.
    assert all(draw.after is not None for draw in told.draws)


def test_refinements_that_end_early_are_not_scored() -> None:
    engine = scripted(("route",))
    engine.times_s = (1.0, 2.0, 3.0)
    with serve(engine, Settings()) as running:
        told = refined(running, refine_request(BEHIND_LEADER, DRAFT))
    assert told.before is not None
    assert {draw.after for draw in told.draws} == {None}


def test_a_full_service_refines_nothing_and_says_when_to_come_back() -> None:
    engine = scripted(("route",))
    with serve(engine, Settings(max_draws=2)) as running, ThreadPoolExecutor(1) as callers:
        running.in_loop(engine.may_finish.clear)
        first = callers.submit(running.http.post, PATH, json=asked())
        running.until(lambda: len(engine.submitted) == 1)
        answer = running.http.post(PATH, json=asked())
        running.in_loop(engine.may_finish.set)
        problem(answer, "queue-full")
        assert answer.headers["Retry-After"]
        assert first.result().status_code == 200
