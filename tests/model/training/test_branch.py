"""The branch learned alone: who is to look twice does, and nothing else changes."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from looktwice.model.bundled import CHECKPOINTS
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.plan import Plan, parse_plan
from looktwice.model.driving.reflection_store import LabelledReflection, write_reflections
from looktwice.model.driving.scene import NO_PICTURE, LabelledScene
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.engines.engine import Controls, DrawFinished, PlanRequest
from looktwice.model.engines.torch.engine import TorchEngine
from looktwice.model.network.checkpoint import load, save, with_second_sketches
from looktwice.model.network.second_sketch import LOOK_GAIN, CurveSpace, Known, SecondSketch, SecondSketcher
from looktwice.model.training.branch import train_branch
from looktwice.model.training.examples import Examples
from looktwice.model.training.own_plans import OwnPlans
from looktwice.model.training.run_settings import RunSettings
from looktwice.model.training.vision_cache import open_vision
from tests.model.training.scenes import training_scene
from tests.model.training.second_sketches import standing_still

WAIT = parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n")
KEEP = parse_plan("- longitudinal\n  - 0.0s-6.4s: Keep Speed\n")
TEXT = "My lane is clear. Going on like this would be needlessly cautious, so I should pick up speed."
SCENES = [each for each in map(training_scene, range(40)) if each.scene.route is not None]


def without_pictures(labelled: LabelledScene) -> LabelledScene:
    clips = tuple(replace(clip, images=(NO_PICTURE,) * len(clip.images)) for clip in labelled.scene.clips)
    return replace(labelled, scene=replace(labelled.scene, clips=clips), dense=())


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
    told: list[tuple[int, int]] = []
    figures = train_branch(
        scenes, resampling_checkpoint, target, file, settings, lambda *done: told.append(done)
    )
    assert figures["auc"] > 0.95, "figures are of plans that were left out"
    assert [total for _, total in told] == [told[-1][0]] * len(told)
    assert told == sorted(set(told)), "progress goes on, to the last prompt"
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


def test_behind_a_critic_it_is_learned_without_reflections(
    resampling_checkpoint: Path, scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target, settings = tmp_path / "from", tmp_path / "to", RunSettings(tmp_path / "cache", bf16=False)
    critical = with_second_sketches(load(resampling_checkpoint))
    save(source, critical.model, critical.vocabulary, critical.codec, dtype=torch.bfloat16, details={})
    # Untrained, a critic has hardly an opinion. This one has another way out wherever it knows the tracks.
    judged_by_nobody = SecondSketcher.forward

    def judged_by_tracks(
        self: SecondSketcher, sketch: Tensor, space: CurveSpace, known: Known
    ) -> SecondSketch:
        found = judged_by_nobody(self, sketch, space, known)
        verdicts = found.verdicts.clone()
        verdicts[..., 0] = -20.0
        if known.tracks is not None:
            verdicts[:, 1:, 0] = 0.0
        return found._replace(verdicts=verdicts)

    monkeypatch.setattr(SecondSketcher, "forward", judged_by_tracks)
    # Scenes without pictures are always given their tracks.
    mixed = [*SCENES[:-4], *map(without_pictures, SCENES[-4:])]
    write_scenes(scenes / "a.parquet", mixed)
    examples = Examples.from_scenes(mixed, critical.settings.cameras)
    own_plans = OwnPlans(
        critical.model, examples, open_vision(critical, examples, settings.cache, mirrored=True)
    )
    choices, pays = {}, 0
    for tracks in (False, True):
        judged_so = own_plans.seconds(tracks=tracks)
        assert judged_so is not None
        looks = standing_still(own_plans, examples, critical.codec, range(len(SCENES)), tracks=tracks)
        choices[tracks] = looks._replace(gains=judged_so.gains)
        pays += int((judged_so.gains[:, 1] >= LOOK_GAIN).sum())
    monkeypatch.setattr(OwnPlans, "seconds", lambda _, *, tracks: choices[tracks])
    figures = train_branch(scenes, source, target, None, settings)
    assert figures["auc"] > 0.9, "its states tell whether a look pays"
    [stage] = load(target).card.details["stages"]
    judged_count = 4 * len(SCENES) - 2 * 4  # with and without tracks, mirrored too
    assert 0 < stage["looks_count"] < pays, "where standing still is nothing new, there is no look"
    looks_count = stage["plans_count"] - (judged_count - pays)
    assert looks_count == stage["looks_count"], "what would pay and cannot be said is no example"


def test_either_reflections_or_a_critic_say_when(
    resampling_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    critical, target = tmp_path / "from", tmp_path / "to"
    file, settings = tmp_path / "reflections.parquet", RunSettings(tmp_path / "cache", bf16=False)
    write_reflections(file, [judged(SCENES[0], WAIT, TEXT)])
    loaded = with_second_sketches(load(resampling_checkpoint))
    save(critical, loaded.model, loaded.vocabulary, loaded.codec, dtype=torch.bfloat16, details={})
    with pytest.raises(ValueError, match="has a critic that says when to look twice: leave the reflections"):
        train_branch(scenes, critical, target, file, settings)
    with pytest.raises(ValueError, match="has no critic: give a build's reflections"):
        train_branch(scenes, resampling_checkpoint, target, None, settings)
    assert not target.exists()


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
