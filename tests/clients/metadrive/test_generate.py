"""Generation in files: resumable after any end, honest in its manifest."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from looktwice.clients.metadrive import simulator
from looktwice.clients.metadrive.generation.blocks import (
    GenerateConfig,
    GenerationError,
    block_file,
    generate,
    write_block,
)
from looktwice.clients.summaries.sheet import contact_sheet
from looktwice.clients.summaries.stats import scene_stats
from looktwice.model.driving.labeller import expert_plan
from looktwice.model.driving.scene import TAGS, LabelledScene, SceneError
from looktwice.model.driving.scene_store import MANIFEST, SceneFileError, read_scenes, write_scenes
from tests.clients.metadrive.conftest import Filmed

CONFIG = GenerateConfig(stride_s=2.0, duration_s=10.0, block=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds: the worker of the first is killed in the middle, then both are generated."""
    out = tmp_path_factory.mktemp("scenes")
    worker = multiprocessing.get_context("spawn").Process(
        target=write_block, args=(out, range(4, 5), GenerateConfig(stride_s=0.5, duration_s=40.0, block=1))
    )
    worker.start()
    time.sleep(2.0)
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    worker.join()
    assert not list(out.glob("*.parquet"))
    generate(out, range(4, 6), workers=2, config=CONFIG)
    return out


def test_a_killed_worker_leaves_nothing_and_the_next_run_everything(folder: Path) -> None:
    seeds = [labelled.seed for labelled in read_scenes(folder)]
    assert set(seeds) == {4, 5}
    names = [labelled.scene.scene_id for labelled in read_scenes(folder)]
    assert len(names) == len(set(names))
    assert not list(folder.glob(".*.tmp"))


def test_a_worker_ends_cleanly(tmp_path: Path) -> None:
    """Panda3D once crashed at exit, after the file was written."""
    config = GenerateConfig(stride_s=2.0, duration_s=9.0, block=1)
    worker = multiprocessing.get_context("spawn").Process(
        target=write_block, args=(tmp_path, range(5, 6), config)
    )
    worker.start()
    worker.join()
    assert worker.exitcode == 0


def test_a_second_run_leaves_what_is_there_alone(folder: Path) -> None:
    file = block_file(folder, range(4, 5))
    before = file.stat().st_mtime_ns
    report = generate(folder, range(4, 6), workers=1, config=CONFIG)
    assert report.blocks_resumed == 2
    assert report.blocks_written == 0
    assert file.stat().st_mtime_ns == before


def test_more_seeds_are_added_to_those_that_are_there(tmp_path: Path) -> None:
    """Blocks of the larger range end elsewhere; what they share with files that are there is left alone."""
    config = replace(CONFIG, duration_s=9.0, block=2)
    generate(tmp_path, range(4, 5), workers=1, config=config)
    shutil.copy(block_file(tmp_path, range(4, 5)), tmp_path / "mine.parquet")
    report = generate(tmp_path, range(4, 7), workers=1, config=config)
    (tmp_path / "mine.parquet").unlink()
    assert (report.blocks_resumed, report.blocks_written) == (1, 1)
    assert block_file(tmp_path, range(5, 7)).exists()
    names = [labelled.scene.scene_id for labelled in read_scenes(tmp_path)]
    assert len(names) == len(set(names))
    assert json.loads((tmp_path / MANIFEST).read_text())["seeds"] == [4, 5, 6]


def test_the_manifest_counts_what_the_files_hold(folder: Path) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    assert manifest["scenes"] == sum(1 for _ in read_scenes(folder))
    assert sorted(manifest["seeds"]) == [4, 5]
    assert manifest["simulator"].startswith("metadrive-simulator 0.3")


def test_another_config_does_not_mix_into_a_folder(folder: Path) -> None:
    with pytest.raises(GenerationError, match="another config"):
        generate(folder, range(6, 7), config=GenerateConfig())


def test_seeds_that_are_held_back_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="not in use"):
        generate(tmp_path, range(700_000, 700_001))


def test_a_missing_simulator_is_said_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator, "is_installed", lambda: False)
    with pytest.raises(simulator.SimulatorMissing, match="make sim"):
        generate(tmp_path, range(1))


def test_statistics_count_scenes_tags_and_words(folder: Path) -> None:
    stats = scene_stats(folder)
    assert stats["scenes"] == sum(1 for _ in read_scenes(folder))
    assert stats["episodes"] == 2
    assert set(stats["tags"]) == set(TAGS)
    assert stats["expert_collisions"] == 0
    assert stats["expert_off_road"] == 0
    words = [labelled_words(labelled) for labelled in read_scenes(folder)]
    assert stats["meta_actions"] == {word: sum(word in of for of in words) for word in stats["meta_actions"]}
    assert set().union(*words) <= set(stats["meta_actions"])
    lane_words = ("Keep Lane", "Left Lane Change", "Right Lane Change")
    assert sum(stats["meta_action_time"][word] for word in lane_words) == pytest.approx(1.0)


def labelled_words(labelled: LabelledScene) -> set[str]:
    plan = expert_plan(labelled)
    return {action.word for _, track in plan.tracks() for action in track}


def test_statistics_need_scenes(tmp_path: Path) -> None:
    write_scenes(tmp_path / "none.parquet", [])
    with pytest.raises(SceneFileError, match="no scenes"):
        scene_stats(tmp_path)


def test_a_contact_sheet_shows_every_scene(filmed: Filmed, tmp_path: Path) -> None:
    contact_sheet(filmed.scenes[:3], tmp_path / "three.png", columns=2)
    contact_sheet(filmed.scenes[:2], tmp_path / "two.png", columns=2)
    with Image.open(tmp_path / "three.png") as three, Image.open(tmp_path / "two.png") as two:
        assert three.width == two.width
        assert 1.8 * two.height < three.height < 2 * two.height  # two rows, one legend


def test_a_contact_sheet_leaves_no_room_for_what_is_not_there(filmed: Filmed, tmp_path: Path) -> None:
    assert filmed.scenes[0].dense
    contact_sheet(filmed.scenes[:1], tmp_path / "dense.png")
    contact_sheet([replace(filmed.scenes[0], dense=())], tmp_path / "plain.png")
    with Image.open(tmp_path / "dense.png") as dense, Image.open(tmp_path / "plain.png") as plain:
        assert plain.width < dense.width
        white = (np.asarray(plain.convert("L")) == 255).mean(axis=0)
    assert (white < 0.5).all()
