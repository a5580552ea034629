"""The branch learned alone: who is to look twice does, and nothing else changes."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.bundled import CHECKPOINTS
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.plan import Plan, parse_plan
from looktwice.model.driving.reflection_store import LabelledReflection, write_reflections
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.engines.engine import Controls, DrawFinished, PlanRequest
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.model.network.checkpoint import load
from looktwice.model.training.branch import train_branch
from looktwice.model.training.run import RunSettings
from tests.model.training.scenes import training_scene

WAIT = parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")
KEEP = parse_plan("- longitudinal\n  - 0.0s-6.4s: Keep Speed\n")
TEXT = "My lane is clear. Going on like this would be needlessly cautious, so I should pick up speed."
SCENES = [each for each in map(training_scene, range(40)) if each.scene.route is not None]


def judged(labelled: LabelledScene, plan: Plan, text: str) -> LabelledReflection:
    held = LabelledReflection(
        labelled.scene.scene_id, plan, "", plan, "", True, True, False, *("x",) * 5, 1, "now"
    )
    return (
        replace(held, reflection=text, expert_plan=expert_plan(labelled), mend="the expert's")
        if text
        else held
    )


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    write_scenes(tmp_path / "scenes" / "a.parquet", SCENES)
    return tmp_path / "scenes"


def test_who_is_to_look_twice_does_and_nothing_else_changes(
    resampling_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    file, target = tmp_path / "reflections.parquet", tmp_path / "to"
    write_reflections(
        file,
        [judged(each, WAIT, TEXT) for each in SCENES[:-6]] + [judged(each, KEEP, "") for each in SCENES[:-6]],
    )
    settings = RunSettings(tmp_path / "cache", bf16=False)
    figures = train_branch(scenes, resampling_checkpoint, target, file, settings)
    assert figures["auc"] > 0.95, "figures are of plans that were left out"
    before = load(resampling_checkpoint).model.bfloat16().state_dict()
    learned = load(target, dtype=torch.bfloat16)
    moved = {
        name for name, value in learned.model.state_dict().items() if not torch.equal(value, before[name])
    }
    assert moved == {"lm_head.weight"}
    changed = (learned.model.lm_head.weight != before["lm_head.weight"]).any(dim=1).nonzero()[:, 0]
    options = [learned.vocabulary.encode(text)[0] for text in ("Action:", "Thinking:")]
    assert sorted(changed.tolist()) == sorted(options)
    assert learned.card.details["stages"][-1]["name"] == "branch"

    waits, keeps = think_probabilities(target, WAIT), think_probabilities(target, KEEP)
    assert waits.min() > 0.5 > keeps.max(), "in scenes that it did not learn from"


def think_probabilities(checkpoint: Path, plan: Plan) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    async def ask() -> list[float | None]:
        engine = TorchEngine(checkpoint)
        await engine.start()
        try:
            requests = [
                PlanRequest(
                    each.scene.scene_id, each.scene, "cf_vla", Controls(n=1, thinking="never", prefill=plan)
                )
                for each in SCENES[-6:]
            ]
            events = [event for request in requests async for event in engine.submit(request)]
        finally:
            await engine.stop()
        return [event.draw.think_probability for event in events if isinstance(event, DrawFinished)]

    return np.array(asyncio.run(ask()), np.float64)


def test_plans_that_all_go_one_way_are_refused(
    resampling_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    file = tmp_path / "reflections.parquet"
    both = [judged(SCENES[0], WAIT, ""), replace(judged(SCENES[1], WAIT, TEXT), judged=False)]
    write_reflections(file, both)
    with pytest.raises(ValueError, match="all plans that are judged go the same way"):
        train_branch(
            scenes, resampling_checkpoint, tmp_path / "to", file, RunSettings(tmp_path / "cache", bf16=False)
        )
    assert not (tmp_path / "to").exists()


def test_a_checkpoint_without_a_branch_is_refused(scenes: Path, tmp_path: Path) -> None:
    file, settings = tmp_path / "reflections.parquet", RunSettings(tmp_path / "cache", bf16=False)
    write_reflections(file, [judged(SCENES[0], WAIT, TEXT)])
    with pytest.raises(ValueError, match="has no branch: it writes elf_vla"):
        train_branch(scenes, CHECKPOINTS["elf-nano"], tmp_path / "to", file, settings)
