from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.scene import FRONT_WIDE
from looktwice.model.driving.trajectory import FloatArray, constant_velocity
from looktwice.model.engines.engine import Controls, DrawFinished, Event, PlanRequest
from looktwice.model.evaluation.open_loop import SceneResult
from looktwice.model.evaluation.report import (
    LEAD_SUBGROUP,
    SOON_SUBGROUP,
    EvaluationReport,
    evaluate_checkpoint,
)
from looktwice.model.evaluation.variants import Variant, standard_variants
from tests.model.driving.drives import MIDDLES_S, agent, labelled_scene
from tests.model.evaluation.fakes import FakeEngine, draw_of

SCENES = [
    labelled_scene(
        10.0 + 0.8 * np.maximum(MIDDLES_S, 0),
        scene_id=f"s{i}",
        episode_id=f"e{i // 2}",
        pictures=i,
        agents=(agent(18, 0, 10),) if i % 2 else (),
    )
    for i in range(6)
]
OWN_PICTURE = {labelled.scene.scene_id: labelled.scene.clip(FRONT_WIDE) for labelled in SCENES}


class LookingEngine(FakeEngine):
    """Plans as far off as what it lacks: the right pictures, the expert's plan, a plan at all."""

    async def submit(self, request: PlanRequest) -> AsyncGenerator[Event]:
        looks_right = request.scene.clip(FRONT_WIDE) == OWN_PICTURE[request.scene.scene_id]
        plain = 1.0 if request.format == "traj_only" else 0.8
        metres = plain * (0.5 if request.controls.prefill else 1.0) * (1.0 if looks_right else 2.0)
        future: FloatArray = next(s.future for s in SCENES if s.scene.scene_id == request.scene.scene_id)
        for index in range(request.controls.n):
            aside = (future + np.array([0, metres, 0, 0])).astype(np.float32)
            yield DrawFinished(draw_of(aside, request.controls.prefill, index=index))


@pytest.fixture(scope="module")
def report() -> EvaluationReport:
    seen: list[tuple[Variant, SceneResult]] = []
    variants = standard_variants(["cf_vla", "traj_only"], Controls(n=2))
    made = asyncio.run(
        evaluate_checkpoint(
            LookingEngine(),
            SCENES,
            variants,
            on_result=lambda variant, result: seen.append((variant, result)),
        )
    )
    assert len(seen) == len(variants) * len(SCENES)
    return made


def test_every_variant_and_baseline_has_a_row_and_those_for_scenes_with_a_lead(
    report: EvaluationReport,
) -> None:
    names = [row.name for row in report.rows]
    assert list(dict.fromkeys(names))[:3] == ["expert", "constant velocity", "constant turn rate"]
    assert len(names) == 3 * (3 + 10)
    assert {(row.subgroup, row.scenes) for row in report.rows} == {
        (None, 6),
        (LEAD_SUBGROUP, 3),
        (SOON_SUBGROUP, 3),
    }
    assert {row.route for row in report.rows if "route" in row.name} == {True}
    assert report.to_json()["scenes"] == 6


def test_what_should_differ_is_compared(report: EvaluationReport) -> None:
    ratio = {(each.name, each.measure): each.ratio for each in report.comparisons}
    for free in ("meta-act", "meta-act + route"):
        plain, shuffled = free.replace("meta-act", "traj-only"), f"{free}, shuffled images : {free}"
        for measure in ("min_ade_m", "avg_ade_m"):
            assert ratio[f"{free} : {plain}", measure] == pytest.approx(0.8, rel=1e-3)
        assert ratio[f"{free}, expert plan : {free}", "min_ade_m"] == pytest.approx(0.5, rel=1e-3)
        assert ratio[shuffled, "avg_ade_m"] == pytest.approx(2.0, rel=1e-3)
        assert ratio[f"{shuffled} [{LEAD_SUBGROUP}]", "avg_ade_m"] == pytest.approx(2.0, rel=1e-3)
        assert (f"{shuffled} [{SOON_SUBGROUP}]", "path_m") in ratio
        for baseline in ("constant velocity", "constant turn rate"):
            assert (f"{free} : {baseline}", "agreed_ade_m") in ratio
    assert not any(name.endswith(": expert") for name, _ in ratio)
    assert not any(name == "meta-act + route : meta-act" for name, _ in ratio)


def test_a_planner_that_copies_its_speed_has_a_response_of_one(report: EvaluationReport) -> None:
    # The engine of this report follows the expert, whatever the speed.
    assert report.speed_response == {"meta-act + route": {0.5: pytest.approx(0), 1.5: pytest.approx(0)}}
    variants = [each for each in standard_variants(["cf_vla"], Controls(n=1)) if each.route]
    copying = asyncio.run(evaluate_checkpoint(FakeEngine(), SCENES, variants))
    told = copying.to_json()["speed_response"]["meta-act + route"]
    assert told == {"0.5": pytest.approx(1.0, abs=0.02), "1.5": pytest.approx(1.0, abs=0.02)}


def test_a_planner_of_ones_own_has_a_row_and_a_response_to_speed() -> None:
    planners = {
        "teacher": lambda labelled: labelled.future,
        "as before": lambda labelled: constant_velocity(labelled.scene.history),
    }
    variants = [each for each in standard_variants(["cf_vla"], Controls(n=1)) if each.route]
    report = asyncio.run(evaluate_checkpoint(FakeEngine(), SCENES, variants, planners=planners))
    row = next(row for row in report.rows if row.name == "teacher")
    assert row.values["agreed_ade_m"] == 0
    assert report.speed_response["teacher"] == {0.5: 0, 1.5: 0}
    assert report.speed_response["as before"] == {0.5: pytest.approx(1), 1.5: pytest.approx(1)}
    alone = asyncio.run(evaluate_checkpoint(FakeEngine(), SCENES, [], planners=planners))
    assert not alone.speed_response, "no variant asks for other speeds"


def test_the_text_holds_rows_comparisons_and_responses(report: EvaluationReport) -> None:
    text = str(report)
    assert "meta-act, shuffled images : meta-act" in text
    assert text.count("\n") == 1 + len(report.rows) + len(report.comparisons) + len(report.speed_response)


def test_a_variant_without_its_free_counterpart_is_only_a_row() -> None:
    alone = Variant("given", "cf_vla", Controls(n=1), expert_plan=True)
    scenes = [replace(scene, agents=()) for scene in SCENES]
    report = asyncio.run(evaluate_checkpoint(FakeEngine(), scenes, [alone]))
    assert report.comparisons == ()
    assert [row.subgroup for row in report.rows] == [None] * 4
