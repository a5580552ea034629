from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from looktwice.model.bundled import SCENES
from looktwice.model.driving.facts import FACTS, SPEED_SCALE_MS, scene_facts
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.evaluation.perception import (
    FactReadings,
    auc,
    format_perception,
    perception_rows,
    read_facts,
)
from looktwice.model.network.checkpoint import load
from looktwice.model.training.perception_gate import format_gate, perception_gate
from looktwice.model.training.small import SmallSettings
from tests.model.network.motions import made_up_motions

BUNDLED = list(read_scenes(SCENES, dense=False))


def reading_of(read: np.ndarray, true: np.ndarray) -> FactReadings:
    count = len(true)
    histories, futures = made_up_motions(count)
    route = np.stack([np.stack([np.arange(1, 21) * 4.0, np.zeros(20)], axis=1)] * count)
    return FactReadings(
        read.astype(np.float32),
        true.astype(np.float32),
        histories,
        route.astype(np.float32),
        futures,
        np.arange(count) // 4,
    )


def facts(count: int) -> np.ndarray:
    """A lead in the own lane for every other scene, at 10 to 70 m."""
    numbers = np.random.default_rng(0)
    true = np.full((count, len(FACTS)), np.nan)
    for place, name in enumerate(FACTS):
        if name.endswith("present"):
            true[:, place] = 0.0
        if name.startswith("road_"):
            true[:, place] = numbers.normal(size=count)
    lead = slice(0, count, 2)
    for field, values in (
        ("present", 1.0),
        ("gap_log_m", np.log1p(numbers.uniform(10, 70, count // 2))),
        ("speed", numbers.uniform(0, 1.5, count // 2)),
        ("standing", numbers.integers(0, 2, count // 2)),
        ("braking", numbers.integers(0, 2, count // 2)),
        ("fixed", 0.0),
    ):
        true[lead, FACTS.index(f"own_0_{field}")] = values
    return true


def test_a_perfect_reader_has_no_error_and_a_blind_one_explains_nothing() -> None:
    true = facts(80)
    perfect = {row["fact"]: row for row in perception_rows(reading_of(np.nan_to_num(true), true))}
    assert perfect["own lane: lead present"] == {"fact": "own lane: lead present", "scenes": 80, "auc": 1.0}
    speed = perfect["own lane, 0 to 60 m: speed along the lane, m/s"]
    assert (speed["error"], speed["r2"]) == (0.0, 1.0)
    assert 0 < speed["scenes"] < 40  # some leads are farther away
    assert perfect["own lane, 0 to 60 m: standing"]["auc"] == 1.0
    assert perfect["own lane, 0 to 60 m: fixed"]["auc"] is None  # none is

    wrong = np.nan_to_num(true)
    place = FACTS.index("own_0_speed")
    wrong[:, place] += 0.1
    off = {row["fact"]: row for row in perception_rows(reading_of(wrong, true))}
    speed = off["own lane, 0 to 60 m: speed along the lane, m/s"]
    assert speed["error"] == pytest.approx(0.1 * SPEED_SCALE_MS, rel=1e-4)
    assert 0 < speed["r2"] < 1

    mean = np.zeros_like(true)
    blind = {row["fact"]: row for row in perception_rows(reading_of(mean, true))}
    assert blind["own lane, 0 to 60 m: standing"]["auc"] == 0.5
    assert blind["own lane, 0 to 60 m: speed along the lane, m/s"]["r2"] <= 0
    assert "standing" in format_perception(list(off.values()))


def test_auc_counts_ties_half() -> None:
    positive = np.array([True, False, True, False])
    assert auc(np.array([0.9, 0.1, 0.8, 0.2]), positive) == 1.0
    assert auc(np.array([0.1, 0.9, 0.2, 0.8]), positive) == 0.0
    assert auc(np.array([0.5, 0.5, 0.9, 0.1]), positive) == 0.875
    assert auc(np.array([0.5, 0.5]), np.array([True, True])) is None


def test_facts_are_read_from_pictures(resampling_checkpoint: Path) -> None:
    loaded = load(resampling_checkpoint)
    done: list[int] = []
    routed = [labelled for labelled in BUNDLED if labelled.scene.route is not None]
    unrouted = replace(routed[0], scene=replace(routed[0].scene, route=None))
    reading = read_facts(loaded, [unrouted, *routed], done.append)
    assert done[-1] == len(routed) == len(reading.read)
    np.testing.assert_array_equal(reading.true, np.stack([scene_facts(labelled) for labelled in routed]))
    assert np.isfinite(reading.read).all()
    elsewhere = replace(routed[0], scene=replace(routed[0].scene, clips=routed[1].scene.clips))
    other = read_facts(loaded, [elsewhere])
    assert np.abs(other.read[0] - reading.read[0]).max() > 1e-3
    with pytest.raises(ValueError, match="no scene has a route"):
        read_facts(loaded, [unrouted])


def test_the_gate_tells_what_facts_are_worth(resampling_checkpoint: Path) -> None:
    codec = load(resampling_checkpoint).codec
    true = facts(128)
    reading = reading_of(np.nan_to_num(true), true)
    # The future is told by a fact alone: the speed of who is ahead.
    reading.future[:, :, 0] *= (0.2 + np.nan_to_num(true[:, FACTS.index("own_0_speed")]))[:, None]
    blurred = reading_of(np.zeros_like(true), true)
    blurred = replace(blurred, future=reading.future)
    settings = SmallSettings(steps=150, batch_size=64)
    rows = {row["facts"]: row for row in perception_gate(reading, reading, codec, settings)}
    assert rows["none"]["against_none"] == 0.0
    assert rows["true"]["ade_m"] < rows["none"]["ade_m"]
    # What is read is what is true here; "present" is told alike too.
    assert rows["read"]["ade_m"] == pytest.approx(rows["true"]["ade_m"], abs=1e-3)
    low, high = rows["true"]["against_none_interval"]
    assert low < rows["true"]["against_none"] < high
    assert "true" in format_gate(list(rows.values()))
