from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from looktwice.model.driving.images import encode_jpeg
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.plan import parse_plan
from looktwice.model.driving.reflection_store import LabelledReflection, write_reflections
from looktwice.model.driving.scene import LabelledScene, NextFrame
from looktwice.model.driving.scene_store import write_scenes
from looktwice.model.network.checkpoint import load, save, with_second_sketches, with_sketches
from looktwice.model.network.visual_codes import VisualCodes
from looktwice.model.network.vla_settings import NANO_SETTINGS
from looktwice.model.training.recipes import NANO, Recipe
from looktwice.model.training.run import last_whole_state, run
from looktwice.model.training.run_settings import RunSettings
from tests.checkpoints import write_untrained
from tests.model.training.scenes import training_scene

SCENES = [training_scene(index) for index in range(16)]


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    write_scenes(tmp_path / "scenes" / "a.parquet", SCENES)
    return tmp_path / "scenes"


def short(name: str, steps: int = 4) -> Recipe:
    return replace(NANO[name], steps=steps, batch_size=4, warmup_steps=1)


def test_the_stages_lead_to_a_checkpoint_that_tells_its_history(
    resampling_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    settings = RunSettings(tmp_path / "cache", validate_every=2, save_every=2, draws=1, bf16=False)
    before = load(resampling_checkpoint).model.bfloat16().state_dict()
    run(short("ground"), scenes, resampling_checkpoint, tmp_path / "ground", settings)
    grounded = load(tmp_path / "ground", dtype=torch.bfloat16).model.state_dict()
    moved = {name for name in before if not torch.equal(before[name], grounded[name])}
    assert moved
    assert all(name.startswith(("model.visual.", "resampler.")) for name in moved)

    run(short("meta-act"), scenes, tmp_path / "ground", tmp_path / "plan", settings, SCENES[:1])
    done = load(tmp_path / "plan")
    # The decoder learned, and the small planners stayed what they are, but for their tokens.
    planned = load(tmp_path / "plan", dtype=torch.bfloat16).model.state_dict()
    learned = {name for name in planned if not torch.equal(planned[name], grounded[name])}
    planners = ("track_reader", "resampler.intent")
    assert any(name.startswith("model.language_model.") for name in learned)
    assert {name for name in learned if name.startswith((*planners, "sketch_books"))} <= {
        f"{planner}.tokens.{each}" for planner in planners for each in ("weight", "bias")
    }
    assert [stage["name"] for stage in done.card.details["stages"]] == ["ground", "meta-act"]
    assert done.card.revision != load(resampling_checkpoint).card.revision
    rows = [json.loads(line) for line in (tmp_path / "plan" / "log.jsonl").read_text().splitlines()]
    assert {row["stage"] for row in rows} == {"1 ground", "2 meta-act"}
    validated = [row for row in rows if "min_ade_m/cf_vla+route" in row]
    assert [row["step"] for row in validated] == [2, 4]
    assert all(0 < row["plan_iou_first/cf_vla"] < 1 for row in validated)


@pytest.mark.parametrize(
    ("recipe", "format"),
    [("elf-pretrain", "elf_vla"), ("elf-sft", "elf_vla"), ("world-sft", "vla_world")],
)
def test_a_checkpoint_learns_a_format_that_it_did_not_write(
    recipe: str, format: str, resampling_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    settings = RunSettings(tmp_path / "cache", validate_every=4, save_every=4, draws=1, bf16=False)
    run(short(recipe), scenes, resampling_checkpoint, tmp_path / "done", settings, SCENES[:1])
    before, done = load(resampling_checkpoint), load(tmp_path / "done")
    assert done.card.formats == (*before.card.formats, format)
    ids = range(len(before.vocabulary))
    assert [done.vocabulary.decode([id]) for id in ids] == [before.vocabulary.decode([id]) for id in ids]
    rows = [json.loads(line) for line in (tmp_path / "done" / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if f"min_ade_m/{format}+route" in row] == [4]


def test_scenes_that_do_not_tell_what_is_taught_are_left_out(
    resampling_checkpoint: Path, tmp_path: Path
) -> None:
    settings = RunSettings(tmp_path / "cache", bf16=False)
    # Without the road's surface nothing is perceived; that leaves no thoughts either.
    silent = [replace(each, drivable=(), lane_map=None) for each in SCENES[:6]]
    write_scenes(tmp_path / "some" / "a.parquet", [*silent, *SCENES[6:12]])
    write_scenes(tmp_path / "none" / "a.parquet", silent)
    for recipe in ("elf-sft", "world-sft"):
        run(short(recipe), tmp_path / "some", resampling_checkpoint, tmp_path / recipe, settings)
        [stage] = load(tmp_path / recipe).card.details["stages"][-1:]
        assert stage["examples"] == 6
        with pytest.raises(ValueError, match=f"no scene tells what recipe {recipe} teaches"):
            run(short(recipe), tmp_path / "none", resampling_checkpoint, tmp_path / "no", settings)
    assert not (tmp_path / "no").exists()


def test_pictures_are_learned_with_codes_that_the_checkpoint_keeps(
    resampling_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    frame = encode_jpeg(np.random.default_rng(0).integers(0, 256, (112, 224, 3), np.uint8))
    filmed = [replace(each, next_frames=(NextFrame("back", frame),)) for each in SCENES[:8]]
    write_scenes(tmp_path / "filmed" / "a.parquet", filmed)
    (tmp_path / "codes").mkdir()
    codes = VisualCodes(24)
    codes.save(tmp_path / "codes", {"steps": 7})
    settings = RunSettings(tmp_path / "cache", bf16=False)
    pretrain, imagined = short("world-pretrain", 2), tmp_path / "pretrained"
    with pytest.raises(ValueError, match="16 scenes bring none"):
        run(pretrain, scenes, resampling_checkpoint, imagined, settings)
    with pytest.raises(ValueError, match="has no codes for them"):
        run(pretrain, tmp_path / "filmed", resampling_checkpoint, imagined, settings)
    run(
        pretrain,
        tmp_path / "filmed",
        resampling_checkpoint,
        imagined,
        settings,
        visual_codes=tmp_path / "codes",
    )
    kept = load(imagined).visual_codes
    assert kept is not None
    assert kept.details == {"steps": 7}
    assert torch.equal(kept.exit.weight, codes.exit.weight)
    # The next stage needs no folder of codes, and hands them on.
    run(short("world-sft", 2), tmp_path / "filmed", imagined, tmp_path / "done", settings)
    assert load(tmp_path / "done").visual_codes is not None
    losses = [json.loads(line) for line in (tmp_path / "done" / "log.jsonl").read_text().splitlines()]
    assert all(np.isfinite(row["loss"]) for row in losses if "loss" in row)


def test_a_vision_tower_can_be_taken_from_elsewhere(
    resampling_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    settings = RunSettings(tmp_path / "cache", bf16=False)
    run(short("ground", 1), scenes, resampling_checkpoint, tmp_path / "ground", settings)
    run(
        short("language", 1),
        scenes,
        resampling_checkpoint,
        tmp_path / "both",
        settings,
        vision_source=tmp_path / "ground",
    )
    both, grounded = load(tmp_path / "both"), load(tmp_path / "ground")
    for name in ("model.visual.merger.mlp.0.weight", "resampler.queries", "resampler.facts.groups.0.weight"):
        assert torch.equal(both.model.state_dict()[name], grounded.model.state_dict()[name])


def test_readers_learn_to_sketch_where_they_did_not(scenes: Path, tmp_path: Path) -> None:
    plain = replace(NANO_SETTINGS, sketch_tokens=0, scene_tokens=18)
    before = write_untrained(tmp_path / "before", settings=plain)
    settings = RunSettings(tmp_path / "cache", bf16=False)
    run(short("read-tracks"), scenes, before, tmp_path / "tracks", settings)
    made = load(tmp_path / "tracks")
    assert made.settings.sketch_tokens == NANO_SETTINGS.sketch_tokens
    reader = made.model.track_reader
    assert reader is not None
    assert reader.sketch is not None
    unread = with_sketches(load(before), NANO_SETTINGS.sketch_tokens).model.track_reader
    assert unread is not None
    assert unread.sketch is not None
    assert not torch.equal(reader.sketch.weight, unread.sketch.weight)
    with pytest.raises(ValueError, match="2 tokens of an intent"):
        run(short("language"), scenes, before, tmp_path / "no", settings, vision_source=tmp_path / "tracks")


def test_a_state_cut_off_by_a_kill_is_passed_over(tmp_path: Path) -> None:
    assert last_whole_state(tmp_path) is None
    for step, text in ((2, "{}"), (10, "{}"), (12, '{"half'), (14, None)):
        folder = tmp_path / f"checkpoint-{step}"
        folder.mkdir()
        if text is not None:
            (folder / "trainer_state.json").write_text(text)
    assert last_whole_state(tmp_path) == str(tmp_path / "checkpoint-10")


_SCRIPT = """
import sys
from pathlib import Path
from dataclasses import replace
from looktwice.model.training.recipes import NANO
from looktwice.model.training.run import run
from looktwice.model.training.run_settings import RunSettings
scenes, source, target, cache = map(Path, sys.argv[1:])
recipe = replace(NANO["language"], steps=12, batch_size=4, warmup_steps=1)
run(recipe, scenes, source, target, RunSettings(cache, save_every=2, bf16=False))
"""


def test_a_killed_run_goes_on(untrained_checkpoint: Path, scenes: Path, tmp_path: Path) -> None:
    target = tmp_path / "target"
    command = [
        sys.executable,
        "-c",
        _SCRIPT,
        *map(str, (scenes, untrained_checkpoint, target, tmp_path / "c")),
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not list((target / "state").glob("checkpoint-[4-9]")) and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (target / "config.json").exists()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    assert load(target).card.details["stages"][0]["steps"] == 12
    last = json.loads((target / "log.jsonl").read_text().splitlines()[-1])
    # The second run's own steps are fewer than all: it did not begin anew.
    assert last["step"] == 12
    assert last["train_samples_per_second"] > 0


def test_two_processes_share_the_work(untrained_checkpoint: Path, scenes: Path, tmp_path: Path) -> None:
    """Batches are dealt out, gradients joined, and one process alone writes log and checkpoint."""
    script = tmp_path / "train.py"
    script.write_text(_SCRIPT.replace('"language"], steps=12', '"meta-act"], steps=6'))
    target = tmp_path / "target"
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
        + [str(path) for path in (scenes, untrained_checkpoint, target, tmp_path / "c")],
        # Both are here: what the machine's name resolves to must not matter.
        env=os.environ | {"GLOO_SOCKET_IFNAME": "lo"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    rows = [json.loads(line) for line in (target / "log.jsonl").read_text().splitlines()]
    assert sum("train_runtime" in row for row in rows) == 1
    assert load(target).card.details["stages"][0]["steps"] == 6


def test_reflections_are_learned_and_counted(
    untrained_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    file = tmp_path / "reflections.parquet"
    write_reflections(file, [reflection(SCENES[3]), reflection(SCENES[4])])
    settings = RunSettings(tmp_path / "cache", bf16=False)
    for name in ("counterfactual", "multi-round"):
        target = tmp_path / name
        run(short(name, 2), scenes, untrained_checkpoint, target, settings, reflections=file)
        assert load(target).card.details["stages"][-1]["reflections_count"] == 2

    def refused(name: str, why: str, reflections: Path | None = file) -> None:
        with pytest.raises(ValueError, match=why):
            run(short(name), scenes, untrained_checkpoint, tmp_path / "no", settings, reflections=reflections)

    refused("counterfactual", "needs reflections", None)
    refused("meta-act", "takes no reflections")
    write_reflections(file, [replace(reflection(SCENES[3]), tracks=True)])
    refused("counterfactual", "plans made with tracks")
    write_reflections(file, [reflection(training_scene(99))])
    refused("counterfactual", "not among the scenes")


def test_sketches_are_learned_where_the_prompt_has_them(
    untrained_checkpoint: Path, resampling_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    file, settings = tmp_path / "reflections.parquet", RunSettings(tmp_path / "cache", bf16=False)
    text = "My lane is clear. Going on like this would be needlessly cautious, so I should pick up speed."
    write_reflections(file, [reflection(SCENES[3], text)])
    wide = load(resampling_checkpoint)
    wide_books = wide.model.sketch_books
    assert wide_books is not None
    wide_books.fill(wide.codec)
    narrow = wide_books.widths.tolist()
    torch.nn.init.constant_(wide_books.widths, 64.0)
    save(tmp_path / "wide", wide.model, wide.vocabulary, wide.codec)
    run(short("sketched", 2), scenes, tmp_path / "wide", tmp_path / "to", settings, reflections=file)
    learned = load(tmp_path / "to")
    assert learned.card.details["stages"][-1]["sketched"]
    books = learned.model.sketch_books
    assert books is not None
    assert books.widths.tolist() == pytest.approx(narrow, rel=0.01), "wide mixtures cannot be copied"
    with pytest.raises(ValueError, match="teaches sketches"):
        run(short("sketched"), scenes, untrained_checkpoint, tmp_path / "no", settings, reflections=file)


def test_a_critic_needs_two_small_planners_that_sketch(
    untrained_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    settings, target = RunSettings(tmp_path / "cache", bf16=False), tmp_path / "no"
    with pytest.raises(ValueError, match="writes none"):
        run(short("critic"), scenes, untrained_checkpoint, target, settings)
    blind = write_untrained(tmp_path / "blind", settings=replace(NANO_SETTINGS, with_tracks=False))
    with pytest.raises(ValueError, match="has one of them"):
        run(short("critic"), scenes, blind, target, settings)
    assert not target.exists()


def test_sketches_of_fewer_codes_are_learned_in_more(scenes: Path, tmp_path: Path) -> None:
    fewer = replace(NANO_SETTINGS, sketch_tokens=3, scene_tokens=21)
    before = with_second_sketches(load(write_untrained(tmp_path / "before", settings=fewer)))
    save(tmp_path / "second", before.model, before.vocabulary, before.codec, dtype=torch.bfloat16)
    settings = RunSettings(tmp_path / "cache", bf16=False)
    run(short("sketched", 2), scenes, tmp_path / "second", tmp_path / "to", settings)
    made = load(tmp_path / "to").settings
    assert made.sketch_tokens == NANO_SETTINGS.sketch_tokens
    assert made.second_sketch


def test_second_sketches_are_learned_without_reflections(
    resampling_checkpoint: Path, scenes: Path, tmp_path: Path
) -> None:
    file, settings = tmp_path / "reflections.parquet", RunSettings(tmp_path / "cache", bf16=False)
    write_reflections(file, [reflection(SCENES[3])])
    wider = with_second_sketches(load(resampling_checkpoint))
    save(tmp_path / "wider", wider.model, wider.vocabulary, wider.codec, dtype=torch.bfloat16)
    with pytest.raises(ValueError, match="takes no reflections"):
        run(short("sketched"), scenes, tmp_path / "wider", tmp_path / "no", settings, reflections=file)
    run(short("sketched", 2), scenes, tmp_path / "wider", tmp_path / "to", settings)
    before, after = (load(tmp_path / name).model.state_dict() for name in ("wider", "to"))
    moved = {name for name, value in before.items() if not torch.equal(value, after[name])}
    assert not {name for name in moved if "critic" in name or ".sketch." in name}
    assert {name for name in moved if "second.verdict" in name}


def reflection(
    labelled: LabelledScene, text: str = "The road ahead is clear, so I should drive on."
) -> LabelledReflection:
    """A reflection on a scene, by nobody in particular."""
    wrong, right = parse_plan("- longitudinal\n  - 0.0s-6.4s: Wait\n"), expert_plan(labelled)
    return LabelledReflection(
        labelled.scene.scene_id, wrong, text, right, "the expert's", True, True, False, *("x",) * 5, 1, "now"
    )
