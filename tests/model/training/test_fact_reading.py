"""Facts are learned from what a frozen tower sees."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.facts import FACTS, mirrored
from looktwice.model.driving.scene import FRONT_TELE, FRONT_WIDE, NO_PICTURE
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.network.checkpoint import load
from looktwice.model.training.batches import stacked
from looktwice.model.training.examples import Examples
from looktwice.model.training.fact_reading import FactDataset, FactLearner, reading_errors
from looktwice.model.training.recipes import NANO
from looktwice.model.training.run import run
from looktwice.model.training.run_settings import RunSettings
from looktwice.model.training.vision_cache import VisionCache, open_vision
from tests.model.training.scenes import training_scene

SCENES = [training_scene(index) for index in range(8)]


@pytest.fixture(scope="module")
def examples() -> Examples:
    return Examples.from_scenes(SCENES, (FRONT_WIDE, FRONT_TELE))


@pytest.fixture(scope="module")
def vision(
    resampling_checkpoint: Path, examples: Examples, tmp_path_factory: pytest.TempPathFactory
) -> VisionCache:
    loaded = load(resampling_checkpoint)
    return open_vision(loaded, examples, tmp_path_factory.mktemp("vision"), mirrored=True)


def test_a_mirrored_look_swaps_everything_it_knows(examples: Examples, vision: VisionCache) -> None:
    data = FactDataset(examples, vision, route_share=1.0)
    plain, swapped = (data.look(1, mirror=mirror, route=True) for mirror in (False, True))
    np.testing.assert_array_equal(swapped.history[:, 1], -plain.history[:, 1])
    np.testing.assert_array_equal(swapped.route[:, 1], -plain.route[:, 1])
    np.testing.assert_array_equal(swapped.facts, mirrored(plain.facts))
    assert not np.array_equal(swapped.tokens, plain.tokens)
    assert plain.has_route
    assert not data.look(1, mirror=False, route=False).has_route


def test_half_of_the_scenes_have_another_past_and_do_not_ask_for_speeds(
    examples: Examples, vision: VisionCache
) -> None:
    examples = replace(examples, facts=examples.facts.copy())
    data = FactDataset(examples, vision, route_share=1.0)
    own = [data.look(1, mirror=mirror, route=True).history for mirror in (False, True)]
    speed, walker = FACTS.index("own_0_speed"), FACTS.index("walker_0_present")
    examples.facts[1, [speed, walker]] = 0.5, 1.0
    others = 0
    for sample in (data[1] for _ in range(200)):
        another = not any(np.array_equal(sample.history, each) for each in own)
        others += another
        assert sample.facts[walker] == 1.0
        assert not another or np.isnan(sample.facts[speed])
    # A scene may be given its own past as another one's.
    assert 40 < others < 120


def test_scenes_are_read_better_after_a_few_steps(
    resampling_checkpoint: Path, examples: Examples, vision: VisionCache
) -> None:
    torch.manual_seed(0)
    learner = FactLearner(load(resampling_checkpoint).model).train()
    data = FactDataset(examples, vision, route_share=1.0)
    batch = stacked([data.look(place, mirror=False, route=True) for place in range(len(data))])
    before = reading_errors(learner, examples, vision)
    assert learner.training
    optimizer = torch.optim.AdamW([each for each in learner.parameters() if each.requires_grad], 1e-3)
    for _ in range(30):
        optimizer.zero_grad()
        learner(**batch)["loss"].backward()
        optimizer.step()
    after = reading_errors(learner, examples, vision)
    assert set(after) == {"fact_loss/read", "fact_loss/read+route"}
    assert all(after[name] < 0.6 * before[name] for name in after)


def test_the_stage_moves_what_reads_and_nothing_else(resampling_checkpoint: Path, tmp_path: Path) -> None:
    clips = tuple(replace(clip, images=(NO_PICTURE,) * 4) for clip in SCENES[0].scene.clips)
    blind = replace(SCENES[0], scene=replace(SCENES[0].scene, clips=clips))
    write_scenes(tmp_path / "scenes" / "a.parquet", [*SCENES, blind])
    settings = RunSettings(tmp_path / "cache", validate_every=2, save_every=2, bf16=False)
    recipe = replace(NANO["read-facts"], steps=4, batch_size=4, warmup_steps=1, learning_rate=1e-2)
    run(recipe, tmp_path / "scenes", resampling_checkpoint, tmp_path / "done", settings, SCENES[:2])
    before = load(resampling_checkpoint).model.bfloat16().state_dict()
    after = load(tmp_path / "done", dtype=torch.bfloat16).model.state_dict()
    moved = {name for name, value in after.items() if name in before and not value.equal(before[name])}
    assert {name.split(".")[1] for name in moved} >= {"layers", "facts", "queries"}
    assert all(name.startswith("resampler.") and ".intent." not in name for name in moved)
    write_scenes(tmp_path / "blind" / "a.parquet", [blind])
    with pytest.raises(ValueError, match="read-facts learns from pictures, and no scene has any"):
        run(recipe, tmp_path / "blind", resampling_checkpoint, tmp_path / "no", settings)
    assert not (tmp_path / "no").exists()
    rows = [json.loads(line) for line in (tmp_path / "done" / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if "fact_loss/read+route" in row] == [2, 4]
