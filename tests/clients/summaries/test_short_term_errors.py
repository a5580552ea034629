from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from looktwice.clients.summaries.short_term_errors import format_short_term, short_term_figures
from looktwice.model.driving.agents import Agent
from looktwice.model.driving.scene import LabelledScene
from looktwice.model.driving.scene_store import SceneFileError, write_scenes
from looktwice.model.driving.short_term import ShortTermError
from tests.model.driving.drives import agent, drive, labelled_scene

LEFT = np.stack([4.0 * np.arange(1, 21), 3 + 0.2 * np.arange(20)], 1).astype(np.float32)


def slowing(speed: float, agents: Sequence[Agent] = ()) -> LabelledScene:
    """Goes at half the speed from now on, as everybody here who is to turn left."""
    made = labelled_scene(speed)
    future, _ = drive(0.5 * speed)
    return replace(
        made, scene=replace(made.scene, route=LEFT), future=future, agents=tuple(agents), drivable=()
    )


def test_what_is_fitted_on_some_scenes_is_measured_on_others(tmp_path: Path) -> None:
    new = agent(20.0, 3.0, speed=2.0, kind="pedestrian")
    new.poses[:15] = np.nan
    gone = agent(30.0, 3.0)
    gone.poses[20:] = np.nan
    later = agent(40.0, 3.0)
    later.poses[:16] = np.nan
    around = [agent(10.0, 0.0, speed=4.0), new, gone, later, agent(5.0, 0.0, kind="cone")]
    write_scenes(tmp_path / "train.parquet", map(slowing, np.linspace(4, 14, 20).tolist()))
    write_scenes(tmp_path / "validation.parquet", [slowing(6.0, around), slowing(10.0)])
    figures = short_term_figures(tmp_path / "train.parquet", tmp_path / "validation.parquet")
    assert (figures["train_scenes"], figures["scenes"]) == (20, 2)
    assert figures["lambda"] == {"left": pytest.approx(1.0), "forward": None, "right": None}
    # At 8 m/s on average, half of which half a second ahead is 2 m.
    assert figures["ego_m"] == pytest.approx(
        {
            "fitted": 0.0,
            "lambda_0": 2.0,
            "lambda_1": 0.0,
            "constant_velocity": 2.0,
            "constant_turn_rate": 2.0,
        },
        abs=1e-3,
    )
    assert figures["agents"] == {
        "vehicle": {"mean_m": pytest.approx(0.0, abs=1e-5), "predicted": 1, "new": 0},
        "pedestrian": {"mean_m": None, "predicted": 0, "new": 1},
    }
    told = format_short_term(figures).splitlines()
    assert told[0] == "lambda, fitted on 20 scenes: left 1.000, forward unknown, right unknown"
    assert told[3].split() == ["ego,", "lambda", "=", "0", "2.000", "m"]
    assert told[-1].split()[4:] == ["unknown,", "0", "predicted,", "1", "new"]


def test_scenes_that_tell_nothing_are_an_error(tmp_path: Path) -> None:
    few, none, enough = (tmp_path / f"{name}.parquet" for name in ("few", "none", "enough"))
    write_scenes(few, map(slowing, [4.0] * 7))
    write_scenes(none, [])
    write_scenes(enough, map(slowing, [4.0] * 8))
    with pytest.raises(ShortTermError, match="8 scenes"):
        short_term_figures(few, enough)
    with pytest.raises(SceneFileError, match="holds no scenes"):
        short_term_figures(enough, none)
