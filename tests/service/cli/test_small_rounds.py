"""`train teacher --rounds`: a small planner drives, and learns from what it met."""

from __future__ import annotations

from pathlib import Path

import pytest

from looktwice.clients.metadrive import simulator
from looktwice.model.bundled import CHECKPOINT
from looktwice.model.driving.scene_store import read_scenes, write_scenes
from looktwice.model.network import small_planner
from looktwice.model.network.small_planner import WEIGHTS_FILE, SmallPlannerError, load_small
from looktwice.model.training.small import SmallSettings
from looktwice.service.cli.small_rounds import FIRST_ROUND_SEED, train_small_in_rounds
from tests.model.training.scenes import training_scene


def test_a_round_learns_from_what_the_planner_met_and_is_not_made_twice(tmp_path: Path) -> None:
    if not simulator.is_installed():
        pytest.skip("MetaDrive is not installed (make sim)")
    scenes, target = tmp_path / "scenes.parquet", tmp_path / "teacher"
    write_scenes(scenes, [training_scene(index) for index in range(6)])

    def train() -> None:
        train_small_in_rounds("teacher", scenes, CHECKPOINT, target, SmallSettings(steps=20), None, 1, 2)

    train()
    [met] = (target / "round-1" / "scenes").glob("*.parquet")
    states = list(read_scenes(met))
    assert {each.seed for each in states} <= {FIRST_ROUND_SEED, FIRST_ROUND_SEED + 1}
    assert not any(each.scene.has_pictures for each in states)
    assert load_small(target).kind == "teacher"
    assert (target / WEIGHTS_FILE).read_bytes() == (target / "round-1" / WEIGHTS_FILE).read_bytes()
    made = {file: file.stat().st_mtime_ns for file in (target / "round-1").rglob("*.*t*")}
    train()
    for file in (met, target / "round-1" / WEIGHTS_FILE):
        assert file.stat().st_mtime_ns == made[file]


def test_a_round_of_other_settings_is_refused_by_its_folder(tmp_path: Path) -> None:
    scenes, target = tmp_path / "scenes.parquet", tmp_path / "blind"
    write_scenes(scenes, [training_scene(index) for index in range(6)])

    def train(seed: int) -> None:
        settings = SmallSettings(steps=2, seed=seed)
        train_small_in_rounds("blind", scenes, CHECKPOINT, target, settings, None, 0, 0)

    train(seed=0)
    weights = (target / WEIGHTS_FILE).read_bytes()
    with pytest.raises(SmallPlannerError, match=r"round-0 has a blind planner of other settings .*'seed': 0"):
        train(seed=1)
    assert (target / WEIGHTS_FILE).read_bytes() == weights


def test_killed_between_its_files_a_round_is_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes, target = tmp_path / "scenes.parquet", tmp_path / "blind"
    write_scenes(scenes, [training_scene(index) for index in range(6)])

    def train() -> None:
        train_small_in_rounds("blind", scenes, CHECKPOINT, target, SmallSettings(steps=2), None, 0, 0)

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(small_planner, "save_file", killed)
        with pytest.raises(KeyboardInterrupt):
            train()
    assert not (target / "round-0" / WEIGHTS_FILE).exists()
    train()
    assert load_small(target).kind == "blind"


def test_rounds_are_for_planners_that_see(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rounds are for the teacher"):
        train_small_in_rounds("blind", tmp_path, CHECKPOINT, tmp_path / "blind", SmallSettings(), None, 1, 2)
    assert not (tmp_path / "blind").exists()
