"""Scenes in which the car is slower or faster than it was, with what the expert does then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from looktwice.clients.metadrive.generation.blocks import GenerateConfig, GenerationError, generate
from looktwice.clients.metadrive.scenes.windows import unpictured_scenes
from looktwice.clients.metadrive.world.episode import run_episode
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import present_speed, speeds
from looktwice.service.cli.commands import app
from tests.clients.metadrive.conftest import SEED

CONFIG = GenerateConfig(stride_s=1.0, duration_s=14.0, dense=False, pictures=False, speeds=True)
_JUMP_MS = 1.0
"""More than anybody's speed changes within 0.1 s."""


def test_the_expert_goes_on_from_another_speed(tmp_path: Path) -> None:
    report = generate(tmp_path, range(SEED, SEED + 1), workers=1, config=CONFIG)
    changed = list(read_scenes(tmp_path))
    assert len(changed) == report.scenes > 3
    recorded = {each.scene.scene_id: each for each in unpictured_scenes(run_episode(SEED, 14.0), 1.0)}
    times = []
    for scene in changed:
        speed_ms = present_speed(scene.scene.history)
        assert not scene.scene.has_pictures
        assert abs(float(speeds(scene.future)[0]) - speed_ms) < _JUMP_MS
        if (was := recorded.get(scene.scene.scene_id)) is not None:
            np.testing.assert_array_equal(scene.scene.route, was.scene.route)
            times.append(speed_ms / present_speed(was.scene.history))
    assert len(times) > 3
    assert min(times) >= 0.39
    assert max(times) <= 1.61
    assert np.ptp(times) > 0.2, "each scene has a speed of its own"


def test_other_speeds_are_the_expert_s_and_have_no_pictures(tmp_path: Path) -> None:
    with pytest.raises(GenerationError, match="pictures do not show"):
        GenerateConfig(dense=False, speeds=True)
    with pytest.raises(GenerationError, match="the expert says what to do from there"):
        GenerateConfig(dense=False, pictures=False, speeds=True, driver="somebody", teacher="somebody")
    command = ["scenes", "generate", str(tmp_path), "--first-seed", "0", "--episodes", "1", "--speeds"]
    told = CliRunner().invoke(app, [*command, "--no-dense"])
    assert told.exit_code == 2
    assert "pictures do not show" in told.output.replace("\n", " ")
