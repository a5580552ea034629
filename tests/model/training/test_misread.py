from __future__ import annotations

import numpy as np
import pytest

from looktwice.model.driving.facts import FACTS, IS_YES_OR_NO
from looktwice.model.training.misread import misread

GAP, PRESENT, SPEED = (FACTS.index(f"own_0_{field}") for field in ("gap_log_m", "present", "speed"))


def scenes(count: int, seed: int) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """True facts: half with a lead somewhere, and a road that bends or not."""
    random = np.random.default_rng(seed)
    facts = np.full((count, len(FACTS)), np.nan, np.float32)
    facts[:, [FACTS.index(name) for name in FACTS if name.endswith("present")]] = 0
    facts[:, [FACTS.index(name) for name in FACTS if name.startswith("road_")]] = random.normal(
        size=(count, 10)
    )
    led = random.random(count) < 0.5
    facts[led, PRESENT], facts[led, GAP] = 1, random.uniform(1, 4, led.sum())
    facts[led, SPEED] = random.uniform(0, 2, led.sum())
    return facts


def test_numbers_are_wrong_as_they_are_where_pictures_are_read() -> None:
    known = scenes(2000, 0)
    # Far leads are read too slow, absent ones are seen in one scene of ten.
    read = np.nan_to_num(known)
    read[:, SPEED] -= np.where(read[:, GAP] > 3, 0.5, 0.0)
    absent = known[:, PRESENT] == 0
    read[:, PRESENT] = np.where(absent, np.where(np.arange(2000) % 10 == 0, 0.8, 0.1), 0.9)
    truth = scenes(1000, 1)
    twice = misread(truth, known, np.stack([read, read], axis=1), np.random.default_rng(2))
    np.testing.assert_array_equal(twice[:, 0], twice[:, 1])
    found = twice[:, 0]
    far, near = np.nan_to_num(truth[:, GAP]) > 3.1, (truth[:, GAP] < 2.9) & (truth[:, PRESENT] == 1)
    assert np.median(found[far, SPEED] - truth[far, SPEED]) == pytest.approx(-0.5, abs=1e-5)
    assert np.median(found[near, SPEED] - truth[near, SPEED]) == pytest.approx(0, abs=1e-5)
    assert np.median(found[far | near, PRESENT]) == pytest.approx(0.9, abs=1e-5)
    nobody = truth[:, PRESENT] == 0
    assert np.mean(found[nobody, PRESENT] > 0.5) == pytest.approx(0.1, abs=0.05)


def test_what_is_or_is_not_so_stays_a_probability() -> None:
    known = scenes(50, 3)
    read = np.nan_to_num(known) + np.random.default_rng(0).normal(size=known.shape).astype(np.float32)
    found = misread(scenes(20, 4), known, read[:, None], np.random.default_rng(0))[:, 0]
    assert np.isfinite(found).all()
    assert found[:, IS_YES_OR_NO].min() >= 0
    assert found[:, IS_YES_OR_NO].max() <= 1


def test_without_pictures_anywhere_nobody_knows() -> None:
    facts = scenes(3, 0)
    with pytest.raises(ValueError, match="how they are read"):
        misread(facts, facts[:0], facts[:0, None], np.random.default_rng(0))
