from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fastapi import FastAPI

from looktwice.clients.labelling.ledger import Ledger, StageRun
from looktwice.clients.labelling.pipeline import StageLimits, StageStopped, Tally, work_through
from looktwice.clients.labelling.rollout import (
    RETRY_POLICY,
    Sampling,
    config_of,
    jobs,
    key_of,
    packed,
    roll_out,
    unpacked,
)
from looktwice.clients.planner import AsyncPlannerClient
from looktwice.clients.wire import ModelName
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.metrics import displacement_errors
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.engine import RequestError
from looktwice.service.operations.settings import Settings
from tests.clients.labelling.builds import MODEL, scenes, without_future
from tests.service.scenes import labelled
from tests.service.scripted_engine import CARD, ScriptedEngine
from tests.service.serving import Served, serve
from tests.sockets import listening

LIMITS = StageLimits(at_once=4, give_up_after_s=20.0, max_error_rate=1.0)


@pytest.fixture
def engine() -> ScriptedEngine:
    return ScriptedEngine()


@pytest.fixture
def served(engine: ScriptedEngine, tmp_path: Path) -> Iterator[Served]:
    with serve(engine, Settings(bundled_scenes=tmp_path / "none")) as running:
        yield running


def rolled(url: str, file: Path, folder: Path) -> tuple[StageRun, Tally]:
    model, chosen = MODEL, Sampling(n=2)

    async def go() -> tuple[StageRun, Tally]:
        async with AsyncPlannerClient(url, RETRY_POLICY) as planner:
            with Ledger(folder) as ledger:
                run = ledger.run("rollout", config_of(model, chosen))
                found = jobs(run, file, lambda _: None)
                return run, await work_through(
                    ledger, run, found, lambda job: roll_out(planner, job.subject, model, chosen), LIMITS
                )

    return asyncio.run(go())


def test_a_scene_is_planned_freely_and_with_the_expert_s_plan(
    served: Served, engine: ScriptedEngine, tmp_path: Path
) -> None:
    file = scenes(tmp_path, 3)
    run, tally = rolled(served.url, file, tmp_path / "build")
    assert (tally.done, tally.dead) == (3, 0)
    expert = expert_plan(labelled())
    prefills = [request.controls.prefill for request in engine.submitted]
    assert len(prefills) == 6
    assert {request.controls.thinking for request in engine.submitted} == {"never"}
    assert [plan for plan in prefills if plan is not None] == [expert] * 3
    with Ledger(tmp_path / "build") as ledger:
        record = next(iter(ledger.entries(run))).record
    assert record["expert_plan"] == str(expert)
    assert len(record["free"]) == len(record["prefilled"]) == 2
    assert all(draw["ade_m"] > 0 and draw["tokens"] > 0 for draw in record["free"] + record["prefilled"])
    assert all(0 <= draw["plan_iou"] <= 1 for draw in record["free"])
    for draw in record["free"]:
        errors = displacement_errors(unpacked(draw["trajectory"])[None], labelled().future)
        assert errors.min_ade_m == pytest.approx(draw["ade_m"], abs=1e-3)
    assert json.dumps(record)


def test_a_packed_trajectory_is_the_same_to_the_last_bit() -> None:
    trajectory = np.random.default_rng(1).normal(0, 40, (64, 4)).astype(np.float32)
    np.testing.assert_array_equal(unpacked(packed(trajectory)), trajectory)


def test_a_scene_the_service_refuses_is_a_dead_letter(
    served: Served, engine: ScriptedEngine, tmp_path: Path
) -> None:
    engine.failure = RequestError("not this one")
    run, tally = rolled(served.url, scenes(tmp_path, 2), tmp_path / "build")
    assert (tally.done, tally.dead) == (0, 2)
    with Ledger(tmp_path / "build") as ledger:
        assert "not this one" in next(iter(ledger.entries(run, "dead"))).record["reason"]


def test_a_service_that_answers_rubbish_is_a_dead_letter(tmp_path: Path) -> None:
    app = FastAPI()
    app.post("/v1/plan")(lambda: {"draws": "none"})
    with listening(app) as (url, _):
        _, tally = rolled(url, scenes(tmp_path, 1), tmp_path / "build")
    assert (tally.done, tally.dead) == (0, 1)


def test_a_service_that_restarts_in_the_middle_is_waited_for(tmp_path: Path) -> None:
    file, folder = scenes(tmp_path, 60), tmp_path / "build"
    settings = Settings(bundled_scenes=tmp_path / "none")
    engine = ScriptedEngine()
    with serve(engine, settings) as served:
        port = int(served.url.rsplit(":", 1)[1])
    slow = ScriptedEngine()
    # A connection that the first server accepted as it ended stays open while this process lives, and
    # nobody answers there.
    policy, limits = replace(RETRY_POLICY, timeout_s=3.0), replace(LIMITS, give_up_after_s=90.0)

    async def go() -> Tally:
        async with AsyncPlannerClient(f"http://127.0.0.1:{port}", policy) as planner:
            with Ledger(folder) as ledger:
                run = ledger.run("rollout", config_of(MODEL, Sampling(n=2)))
                work = asyncio.create_task(
                    work_through(
                        ledger,
                        run,
                        jobs(run, file, lambda _: None),
                        lambda job: roll_out(planner, job.subject, MODEL, Sampling(n=2)),
                        limits,
                    )
                )
                await asyncio.sleep(0.3)  # nobody is there yet
                assert not work.done()
                with ExitStack() as running:
                    running.enter_context(serve(slow, settings, port=port))
                    while ledger.count(run) < 3:
                        await asyncio.sleep(0.005)
                    # Meanwhile the caller goes on sending what it has begun to send.
                    await asyncio.to_thread(running.close)
                assert not work.done(), "it was to be interrupted in the middle"
                with serve(ScriptedEngine(), settings, port=port):
                    return await work

    tally = asyncio.run(go())
    assert (tally.done, tally.dead) == (60, 0)


def test_another_model_behind_the_service_stops_it(
    served: Served, engine: ScriptedEngine, tmp_path: Path
) -> None:
    engine.card_shown = replace(CARD, revision="r2")
    with pytest.raises(StageStopped, match="r2 instead of r1"):
        rolled(served.url, scenes(tmp_path, 1), tmp_path / "build")


def test_keys_change_with_all_that_decides(tmp_path: Path) -> None:
    one = labelled("a")
    moved = replace(one, scene=replace(one.scene, history=one.scene.history * np.float32(1.01)))
    other_future = replace(one, future=one.future * np.float32(0.9))
    clips = one.scene.clips
    swapped = replace(clips[0], images=(clips[0].images[1], clips[0].images[0], *clips[0].images[2:]))
    other_pictures = replace(one, scene=replace(one.scene, clips=(swapped, clips[1])))
    variants = [one, labelled("b"), moved, other_future, other_pictures]
    with Ledger(tmp_path) as ledger:
        run = ledger.run("rollout", config_of(MODEL, Sampling()))
        assert len({key_of(run, variant) for variant in variants}) == len(variants)
        configs = [
            config_of(MODEL, Sampling()),
            config_of(MODEL, Sampling(temperature=0.5)),
            config_of(ModelName(name="scripted", revision="r2"), Sampling()),
        ]
        assert len({ledger.run("rollout", config).id for config in configs}) == 3


def test_scenes_without_an_expert_s_future_are_named(tmp_path: Path) -> None:
    file = scenes(tmp_path, 3)
    without_future(file, "scene-0001")
    named: list[str] = []
    with Ledger(tmp_path / "build") as ledger:
        run = ledger.run("rollout", {})
        assert [job.scene_id for job in jobs(run, file, named.append)] == ["scene-0000", "scene-0002"]
    assert named == ["scene-0001"]
    with pytest.raises(ValueError, match="holds a row that is no scene"):
        list(read_scenes(file))
