from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.tracks import tracks_of
from looktwice.model.engines.engine import Controls, EngineError
from looktwice.model.evaluation.open_loop import SceneResult
from looktwice.model.evaluation.variants import (
    Variant,
    evaluate_engine,
    request_for,
    standard_variants,
    with_shuffled_images,
)
from tests.model.driving.drives import agent, labelled_scene
from tests.model.evaluation.fakes import FakeEngine

SCENES = [labelled_scene(8.0 + i, scene_id=f"s{i}", episode_id=f"e{i // 3}", pictures=i) for i in range(10)]
FREE = Variant("free", "cf_vla", Controls(n=3))


def evaluate(engine: FakeEngine, variant: Variant = FREE, concurrency: int = 4) -> list[SceneResult]:
    return asyncio.run(evaluate_engine(engine, SCENES, variant, concurrency=concurrency))


def test_results_come_in_the_scenes_order_and_progress_as_they_finish() -> None:
    seen: list[SceneResult] = []
    engine = FakeEngine()
    results = asyncio.run(evaluate_engine(engine, iter(SCENES), FREE, concurrency=4, on_result=seen.append))
    assert [result.scene_id for result in results] == [f"s{i}" for i in range(10)]
    assert sorted(seen, key=lambda result: result.scene_id) == results
    for result in results:
        assert result.min_ade_m < 1e-3
        assert result.avg_ade_m == pytest.approx(1.0, abs=1e-3)  # 0, 1 and 2 m aside


def test_scenes_are_read_no_faster_than_they_are_planned_for() -> None:
    engine = FakeEngine(company=3)
    ahead: list[int] = []

    def reading() -> Iterator[LabelledScene]:
        for index, labelled in enumerate(SCENES):
            ahead.append(index - len(engine.requests))
            yield labelled

    asyncio.run(evaluate_engine(engine, reading(), FREE, concurrency=3))
    assert engine.most_under_way == 3
    assert max(ahead) <= 3


def test_requests_carry_what_the_variant_says() -> None:
    labelled = SCENES[4]
    free = request_for(labelled, FREE)
    assert free.scene.route is None
    assert free.controls.prefill is None
    assert free.scene.clips == labelled.scene.clips
    full = request_for(
        labelled, Variant("full", "other", Controls(n=2, thinking="never"), route=True, expert_plan=True)
    )
    np.testing.assert_array_equal(np.asarray(full.scene.route), np.asarray(labelled.scene.route))
    assert full.controls.prefill == expert_plan(labelled)
    assert (full.format, full.controls.n, full.controls.thinking) == ("other", 2, "never")


def test_chances_differ_from_scene_to_scene_and_agree_between_variants() -> None:
    seeds = [request_for(labelled, FREE).controls.seed for labelled in SCENES]
    assert len(set(seeds)) == len(seeds)
    assert seeds == [request_for(labelled, Variant("other", "cf_vla")).controls.seed for labelled in SCENES]
    assert seeds != [
        request_for(scene, Variant("x", "cf_vla", Controls(seed=1))).controls.seed for scene in SCENES
    ]


def test_a_prefilled_plan_reaches_the_results() -> None:
    results = evaluate(FakeEngine(), Variant("prefilled", "cf_vla", expert_plan=True))
    assert {result.plan_iou_first for result in results} == {1.0}


def test_a_route_that_is_missing_is_an_error() -> None:
    bare = replace(SCENES[0], scene=replace(SCENES[0].scene, route=None))
    with pytest.raises(ValueError, match="scene s0 has no route"):
        request_for(bare, Variant("routed", "cf_vla", route=True))


def test_the_engines_error_comes_through() -> None:
    with pytest.raises(EngineError, match="out of memory"):
        evaluate(FakeEngine(broken=frozenset({"s3"})))
    with pytest.raises(EngineError, match="free/s0: 2 draws came for 3"):
        evaluate(FakeEngine(missing=1), concurrency=1)


def test_shuffled_images_come_from_other_episodes_each_once() -> None:
    shuffled = list(with_shuffled_images(SCENES))
    owner = {labelled.scene.clips: labelled.episode_id for labelled in SCENES}
    for before, after in zip(SCENES, shuffled, strict=True):
        assert owner[after.scene.clips] != before.episode_id
        np.testing.assert_array_equal(after.scene.history, before.scene.history)
        np.testing.assert_array_equal(after.future, before.future)
    assert {labelled.scene.clips for labelled in shuffled} == set(owner)
    again = [labelled.scene.clips for labelled in with_shuffled_images(SCENES)]
    assert again == [labelled.scene.clips for labelled in shuffled]
    assert again != [labelled.scene.clips for labelled in with_shuffled_images(SCENES, seed=1)]


def test_the_engine_gets_the_shuffled_images() -> None:
    engine = FakeEngine()
    evaluate(engine, Variant("shuffled", "cf_vla", shuffled_images=True))
    given = {request.scene.scene_id: request.scene.clips for request in engine.requests}
    assert given == {
        labelled.scene.scene_id: labelled.scene.clips for labelled in with_shuffled_images(SCENES)
    }


def test_images_that_cannot_be_shuffled_across_episodes_are_an_error() -> None:
    with pytest.raises(ValueError, match="of these 3 one has"):
        list(with_shuffled_images(SCENES[:3]))
    with pytest.raises(ValueError, match="gone through twice"):
        list(with_shuffled_images(iter(SCENES)))


def test_the_standard_rows_fit_what_a_checkpoint_writes() -> None:
    both = standard_variants(["cf_vla", "traj_only"], Controls(n=4))
    assert len({variant.name for variant in both}) == len(both) == 10
    assert {variant.format for variant in standard_variants(["traj_only"])} == {"traj_only"}
    assert all(variant.controls.n == 4 for variant in both)
    for route in (False, True):
        of_route = [variant for variant in both if variant.route is route]
        assert sum(variant.expert_plan for variant in of_route) == 1
        assert sum(variant.shuffled_images for variant in of_route) == 1
    takes_tracks = standard_variants(["cf_vla"], inputs=("route", "tracks"))
    assert [variant.name for variant in takes_tracks if variant.tracks] == [
        "meta-act + route + tracks",
        "meta-act + route + tracks, expert plan",
        "meta-act + route + tracks, shuffled images",
        "meta-act + route + tracks, speed x 0.5",
        "meta-act + route + tracks, speed x 1.5",
    ]


def test_tracks_are_given_where_the_variant_says_so() -> None:
    car = agent(12.0, 0.0)
    labelled = labelled_scene(8.0, agents=(car,))
    seen = request_for(labelled, replace(FREE, tracks=True)).scene
    assert seen.tracks == tracks_of(labelled.agents)
    assert request_for(labelled, FREE).scene.tracks is None


def test_another_speed_is_the_same_way_driven_faster() -> None:
    request = request_for(SCENES[3], Variant("fast", "cf_vla", speed=1.5))
    history = SCENES[3].scene.history
    np.testing.assert_allclose(request.scene.history[:, :3], 1.5 * history[:, :3], rtol=1e-6)
    np.testing.assert_array_equal(request.scene.history[:, 3], history[:, 3])


def test_the_likeliest_response_is_asked_for_beside_the_draws() -> None:
    engine = FakeEngine()
    results = evaluate(engine, replace(FREE, greedy=True))
    assert all(result.greedy_ade_m is not None for result in results)
    greedy = [request for request in engine.requests if request.controls.temperature == 0]
    assert len(greedy) == len(SCENES)
    assert {request.controls.n for request in greedy} == {1}
