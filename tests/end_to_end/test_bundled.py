"""What ships, as users meet it: the bundled checkpoint through socket, client and commands."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from looktwice.clients import wire
from looktwice.clients.planner import PlannerClient, PlanResult
from looktwice.model.bundled import CHECKPOINT, SCENES
from looktwice.model.driving.images import decode_image
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.scene import split_of_seed
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.engines.engine import Controls, Draw, DrawFinished, PlanRequest
from looktwice.model.engines.torch.engine import TorchEngine, TorchSettings
from looktwice.model.evaluation.open_loop import BASELINES, evaluate_baselines, evaluate_trajectories
from looktwice.model.families.cf_vla import CF_VLA
from looktwice.model.formats.cursor import CompiledFormat
from looktwice.model.formats.text import parse
from looktwice.model.network.checkpoint import read_parts
from tests.service.serving import Served

BUNDLED = list(read_scenes(SCENES))


def test_bundled_scenes_are_twelve_that_show_every_tag_none_of_them_learned_from() -> None:
    assert len(BUNDLED) == 12
    assert [split_of_seed(labelled.seed) for labelled in BUNDLED] == ["validation", *["test"] * 11]
    assert len({tag for labelled in BUNDLED for tag in labelled.tags}) == 6


def test_every_bundled_scene_has_a_lane_map_and_next_frames_of_its_cameras() -> None:
    for labelled in BUNDLED:
        assert labelled.lane_map is not None, labelled.scene.scene_id
        now = {clip.camera: clip.images[-1] for clip in labelled.scene.clips}
        later = {frame.camera: frame.image for frame in labelled.next_frames}
        assert later.keys() == now.keys(), labelled.scene.scene_id
        for camera, picture in later.items():
            assert picture != now[camera]
            assert decode_image(picture).shape == decode_image(now[camera]).shape


def test_the_checkpoint_is_small_and_tells_how_it_was_made(served: Served[TorchEngine]) -> None:
    assert sum(file.stat().st_size for file in CHECKPOINT.rglob("*")) < 40_000_000
    card = served.http.get("/v1/models").json()["models"][0]
    stages = [stage["name"] for stage in card["details"]["stages"]]
    assert stages.index("meta-act") < stages.index("counterfactual") < stages.index("sketched")
    assert stages[-1] == "branch"


def test_it_thinks_by_itself_now_and_then(planner: PlannerClient) -> None:
    drawn = [planner.plan(labelled.scene, wire.Controls(n=12, seed=2)).draws for labelled in BUNDLED]
    reasons = [{draw.thinking for draw in draws if draw.thinking is not None} for draws in drawn]
    draws = [draw for each in drawn for draw in each]
    thoughts = [draw for draw in draws if draw.thinking is not None]
    assert 0.02 < len(thoughts) / len(draws) < 0.6
    assert all(draw.revised_plan is not None and draw.plan is not None for draw in thoughts)
    assert len(set.union(*reasons)) > sum(map(bool, reasons)) / 2, "reasons are those of the scene"


def test_the_page_opens_on_a_scene_where_a_second_look_happens(served: Served[TorchEngine]) -> None:
    """The first one of the list, asked for as the page does before anything is changed."""
    first = served.http.get("/v1/scenes").json()["scenes"][0]["scene_id"]
    scene = served.http.get(f"/v1/scenes/{first}").json()["scene"]
    controls = {"n": 6, "temperature": 1, "seed": 0}
    answer = served.http.post("/v1/plan", json={"scene": scene, "controls": controls}, timeout=120).json()
    assert any(draw["thinking"] for draw in answer["draws"])


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_it_plans_in_the_types_of_gpus_and_of_checks(dtype: torch.dtype) -> None:
    settings = TorchSettings(rows=6, dtype=dtype, products=None)

    async def planned() -> list[Draw]:
        engine = TorchEngine(CHECKPOINT, settings)
        await engine.start()
        try:
            request = PlanRequest("one", BUNDLED[0].scene, "cf_vla", Controls(n=6, thinking="always"))
            return [event.draw async for event in engine.submit(request) if isinstance(event, DrawFinished)]
        finally:
            await engine.stop()

    draws = asyncio.run(planned())
    assert len(draws) == 6
    assert all(draw.thinking for draw in draws)
    assert np.isfinite(np.stack([draw.trajectory for draw in draws])).all()


def test_it_plans_better_than_keeping_on(planner: PlannerClient) -> None:
    """Over the twelve scenes; the evaluation over a thousand is `looktwice evaluate`."""
    baselines = evaluate_baselines(BUNDLED)
    kept_on = [
        np.mean([result.min_ade_m for result in results])
        for name, results in baselines.items()
        if name in BASELINES
    ]
    errors = []
    for labelled in BUNDLED:
        answer = planner.plan(labelled.scene, wire.Controls(n=6, seed=1))
        draws = np.stack([draw.trajectory for draw in answer.draws])
        assert all(draw.plan is not None for draw in answer.draws)
        errors.append(evaluate_trajectories(labelled, draws).min_ade_m)
    assert np.mean(errors) < 0.8 * min(kept_on)


def test_hundreds_of_hot_draws_all_parse() -> None:
    """Read back strictly, from text alone, at a temperature that makes a model of this size babble."""
    hot = [Controls(n=40, temperature=1.5, seed=1), Controls(n=4, temperature=1.5, thinking="always")]
    requests = [
        PlanRequest(f"{labelled.scene.scene_id} {index}", labelled.scene, "cf_vla", controls=controls)
        for labelled in BUNDLED
        for index, controls in enumerate(hot)
    ]

    async def write() -> list[Draw]:
        engine = TorchEngine(CHECKPOINT)
        await engine.start()
        try:
            events = [event for request in requests async for event in engine.submit(request)]
        finally:
            await engine.stop()
        return [event.draw for event in events if isinstance(event, DrawFinished)]

    draws = asyncio.run(write())
    assert len(draws) == 12 * 44
    compiled = CompiledFormat(CF_VLA.format, read_parts(CHECKPOINT).vocabulary)
    for draw in draws:
        values = parse(compiled, draw.text)
        assert (values["plan"], values["branch"], values["trajectory"]) == (
            draw.plan,
            draw.branch,
            draw.codes,
        )
        assert values.get("revised_plan") == draw.revised_plan
        assert np.isfinite(draw.trajectory).all()
    assert {draw.branch for draw in draws} == {"Action:", "Thinking:"}


def test_the_same_seed_gives_the_same_answer(planner: PlannerClient) -> None:
    def planned(seed: int) -> PlanResult:
        return planner.plan(BUNDLED[0].scene, wire.Controls(n=2, seed=seed, numbers="drawn", codes="drawn"))

    first, second, other = map(planned, (5, 5, 6))
    for one, again in zip(first.draws, second.draws, strict=True):
        assert np.array_equal(one.trajectory, again.trajectory)
    assert not np.array_equal(first.draws[0].trajectory, other.draws[0].trajectory)


def test_broken_json_is_a_problem_and_disturbs_nobody(
    served: Served[TorchEngine], planner: PlannerClient
) -> None:
    answer = served.http.post("/v1/plan", content=b"{" * 1000, headers={"content-type": "application/json"})
    assert answer.status_code == 400
    assert answer.headers["content-type"] == "application/problem+json"
    assert planner.plan(BUNDLED[0].scene, wire.Controls(n=1)).draws


@pytest.mark.parametrize(("name", "draws"), [("plan", 6), ("reflect", 2)])
def test_the_readmes_requests_are_answered(served: Served[TorchEngine], name: str, draws: int) -> None:
    body = (Path(__file__).parents[2] / "docs" / "examples" / f"{name}-request.json").read_bytes()
    answer = served.http.post(f"/v1/{name}", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == 200
    assert len(answer.json()["draws"]) == draws


def test_a_given_plan_is_looked_at(planner: PlannerClient) -> None:
    given = parse_plan("- longitudinal\n  - 0.0s-6.4s: Reverse\n")
    controls = wire.ReflectControls(n=3, thinking="always")
    result = planner.reflect(BUNDLED[0].scene, given, controls)
    assert result.plan == given
    for look in result.draws:
        assert look.thinking
        assert look.revised_plan is not None
        assert (look.decision == "revise") == (look.revised_plan != given) == bool(look.changes)
    kept = planner.reflect(BUNDLED[0].scene, given, wire.ReflectControls(n=2, thinking="never"))
    assert [look.decision for look in kept.draws] == ["keep", "keep"]
    assert kept.think_probability == pytest.approx(result.think_probability, abs=0.05)


def test_metrics_count_tokens_by_section(served: Served[TorchEngine], planner: PlannerClient) -> None:
    name = "looktwice_section_tokens_sum"
    before = served.metric(name, section="trajectory")
    planner.plan(BUNDLED[1].scene, wire.Controls(n=3))
    assert served.metric(name, section="trajectory") > before


def looktwice(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from looktwice.service.cli import main; main()", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_the_command_prints_a_plan_and_writes_a_picture(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-c",
        "from looktwice.service.cli import main; main()",
        "plan",
        "--json",
        "--out",
        str(tmp_path),
    ]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120)
    report = json.loads(done.stdout)
    assert len(report["draws"]) == 6
    assert report["draws"][0]["text"].startswith("Meta Actions:\n- longitudinal\n")
    with Image.open(report["picture"]) as picture:
        assert picture.size == (1400, 900)


def test_a_damaged_scene_file_says_so(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.parquet"
    damaged.write_bytes(SCENES.read_bytes()[:5000])
    done = looktwice("plan", str(damaged))
    assert done.returncode == 2
    assert "truncated" in done.stderr
    assert "Traceback" not in done.stderr


def test_it_is_ready(served: Served[TorchEngine]) -> None:
    served.until_ready()
