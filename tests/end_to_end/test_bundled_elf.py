"""What ships of ELF-VLA, as users meet it: it thinks, answers and refines over HTTP and by command."""

from __future__ import annotations

import numpy as np

from looktwice.clients import wire
from looktwice.clients.planner import PlannerClient, refine_request
from looktwice.clients.wire_refine import RefineResponse
from looktwice.model.bundled import CHECKPOINTS, SCENES
from looktwice.model.driving.pdm.feedback import RuleFeedback
from looktwice.model.driving.pdm.judging import SceneJudge
from looktwice.model.driving.pdm.labelled import plans_of
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import FloatArray, constant_velocity
from looktwice.model.engines.torch.engine import TorchEngine
from tests.end_to_end.test_bundled import looktwice
from tests.service.serving import Served

BUNDLED = list(read_scenes(SCENES))
CHECKPOINT = CHECKPOINTS["elf-nano"]


def test_it_is_small_and_tells_how_it_was_made(served: Served[TorchEngine]) -> None:
    assert sum(file.stat().st_size for file in CHECKPOINT.rglob("*")) < 40_000_000
    [card] = served.http.get("/v1/models").json()["models"]
    assert (card["name"], card["reflects"], card["refines"]) == ("elf-nano", [], ["elf_vla_refine"])
    assert [stage["name"] for stage in card["details"]["stages"]][-2:] == ["elf-sft", "elf-sft"]


def test_it_says_what_is_there_and_scores_better_than_keeping_on(planner: PlannerClient) -> None:
    """Over the twelve scenes; `looktwice evaluate --preset failures` tells it of many."""
    own, kept_on = list[float](), list[float]()
    for labelled in BUNDLED:
        answer = planner.plan(labelled.scene, wire.Controls(n=6, seed=1), format="elf_vla")
        for draw in answer.draws:
            assert draw.thinking is not None
            assert draw.thinking.startswith("Road edges: ")
            assert draw.trajectory.shape == (8, 4)
        judge = SceneJudge(labelled)
        agreed = answer.draws[answer.agreed].trajectory
        steady = constant_velocity(labelled.scene.history)[4:40:5]
        for scores, poses in ((own, agreed), (kept_on, steady)):
            scores.append(float(judge.scores(plans_of(poses[None]), "v1.1").partial_score[0]))
    # Where nothing is known of a plan, such as one far off every lane, it is worth nothing.
    assert np.nan_to_num(own).mean() > np.nan_to_num(kept_on).mean() + 0.1


def test_refinements_of_drafts_that_fail_score_better_and_heed_what_is_said(planner: PlannerClient) -> None:
    """Any own plan may score better than such a draft; told that it is right, models stay nearer to it."""
    before, after = list[float](), list[float]()
    away_m, away_if_right_m = list[float](), list[float]()
    controls = wire.ReflectControls(n=4, seed=1)
    for labelled in BUNDLED:
        scene = labelled.given(route=True, tracks=True)
        steady = constant_velocity(labelled.scene.history)[4:40:5]
        told = planner.refine(refine_request(scene, steady, controls=controls))
        scores = [
            None if each is None else each.partial_score
            for each in (told.before, *(draw.after for draw in told.draws))
        ]
        known = [score for score in scores if score is not None]
        assert len(known) == 5
        if known[0] < 0.8:
            before.append(known[0])
            after.append(sum(known[1:]) / 4)
            right = str(RuleFeedback(1.0, correct=True))
            away_m.append(apart_m(told, steady))
            away_if_right_m.append(
                apart_m(planner.refine(refine_request(scene, steady, right, controls)), steady)
            )
    assert len(before) > 2
    assert np.mean(after) > np.mean(before) + 0.1
    assert np.mean(away_m) > np.mean(away_if_right_m) + 0.5


def apart_m(told: RefineResponse, draft: FloatArray) -> float:
    """The mean distance between where refinements end and where their draft does."""
    ends = np.array([draw.trajectory[-1][:2] for draw in told.draws])
    return float(np.hypot(*(ends - draft[-1, :2]).T).mean())


def test_commands_take_it_by_its_name() -> None:
    done = looktwice("plan", "--checkpoint", "elf-nano")
    assert done.returncode == 0, done.stderr
    assert "\nThoughts: Road edges: " in done.stdout
    assert "Meta actions" not in done.stdout, "it writes none"
    assert "None" not in done.stdout
