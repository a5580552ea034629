"""Our scores beside those of NAVSIM's own scorer, frozen with the commit that they came from."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from looktwice.model.driving.pdm.comfort import Version
from looktwice.model.driving.pdm.plan_simulator import reference_poses, simulate
from looktwice.model.driving.pdm.scoring import (
    COMFORT,
    EXTENDED_COMFORT,
    PROGRESS,
    Others,
    Scores,
    score,
)
from tests.model.driving.pdm.frozen import FULL_STATES, NAMES, SCORE, STATE_STEPS, WORLDS
from tests.model.driving.pdm.worlds import Case, case

FOLDER = Path(__file__).parents[3] / "data" / "pdm"
VERSIONS: tuple[Version, ...] = ("v1.1", "v2.2")
PARTS = 10


@cache
def frozen(version: Version) -> dict[str, Any]:
    with np.load(FOLDER / f"navsim-{version}.npz") as file:
        return {name: file[name] for name in file}


def columns(scores: Scores) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Our scores in the fixture's columns."""
    nothing = np.full(len(scores.score), np.nan)
    found = [scores.sub_scores.get(name) for name in NAMES if name != SCORE]
    return np.stack([nothing if each is None else each for each in found] + [scores.partial_score], axis=-1)


def ours(drawn: Case, version: Version) -> Scores:
    return score(drawn.world, drawn.plans, version, Others(reference=drawn.reference))


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("version", VERSIONS)
def test_sub_scores_are_navsims(version: Version, part: int) -> None:
    expected = frozen(version)
    count = WORLDS // PARTS
    differing = []
    for seed in range(part * count, (part + 1) * count):
        found = columns(ours(case(seed), version))
        same = np.isclose(found, expected["scores"][seed], rtol=0, atol=1e-9, equal_nan=True)
        differing += [
            (seed, plan, NAMES[column], found[plan, column], expected["scores"][seed, plan, column])
            for plan, column in zip(*np.nonzero(~same), strict=True)
            if not expected["near"][seed, plan]
        ]
    assert differing == []


@pytest.mark.parametrize("version", VERSIONS)
def test_the_fixture_covers_every_outcome(version: Version) -> None:
    expected = frozen(version)
    assert json.loads(str(expected["about"]))["version"] == version
    assert expected["scores"].shape == (WORLDS, 5, len(NAMES))
    assert expected["near"].sum() <= 25, "plans near a boundary are the exception"
    for column, name in enumerate(NAMES):
        values = expected["scores"][..., column]
        if np.isnan(values).all():
            assert version == "v1.1"
            continue
        # Each is failed and passed by at least one plan of a hundred.
        assert (values == 0).mean() >= 0.01, name
        assert (values > 0.99).mean() >= 0.01, name


def test_states_are_those_of_navsims_simulator() -> None:
    expected = frozen("v2.2")
    worst = 0.0
    for seed in range(WORLDS):
        drawn = case(seed)
        world = drawn.world
        states = simulate(reference_poses(drawn.plans, world.vehicle, world.ego), world.vehicle, world.ego)
        worst = max(worst, float(np.abs(states[:, STATE_STEPS] - expected["states"][seed]).max()))
        if seed < FULL_STATES:
            worst = max(worst, float(np.abs(states - expected["states_full"][seed]).max()))
    assert worst < 1e-9


def test_extended_comfort_and_the_human_filter_are_navsims() -> None:
    expected = frozen("v2.2")
    forgiven = 0
    for seed in range(WORLDS):
        drawn = case(seed)
        world = drawn.world
        references = reference_poses(drawn.previous[None], world.vehicle, world.ego)
        previous = simulate(references, world.vehicle, world.ego)[0]
        found = score(
            world,
            drawn.plans,
            "v2.2",
            Others(reference=drawn.reference, previous=previous, human=drawn.human),
        )
        assert found.sub_scores[EXTENDED_COMFORT] == pytest.approx(expected["extended"][seed].astype(float))
        for column, name in enumerate(NAMES[:-1]):
            wanted = expected["scores"][seed, :, column]
            if name not in (PROGRESS, COMFORT) and expected["human"][seed, column] == 0:
                wanted = np.ones(5)
                forgiven += 1
            assert found.sub_scores[name] == pytest.approx(wanted, abs=1e-9), (seed, name)
    assert forgiven > 250
