"""Freeze what NAVSIM's own scorer says of random worlds; `looktwice.model.bench.navsim_scorer` tells what it
needs.

From the repository's root, once for each version, in as many parts as there are processors:

    python -m tests.model.driving.pdm.make_fixture VERSION COMMIT OUT.npz FIRST END NAVSIM NUPLAN
    python -m tests.model.driving.pdm.make_fixture join OUT.npz PART.npz...
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, Literal

import numpy as np

from looktwice.model.bench.navsim_scorer import NavsimScorer
from looktwice.model.driving.pdm.scoring import score_states
from looktwice.model.driving.pdm.world import STATE_SIZE, STEPS, Array, BoolArray, World
from tests.model.driving.pdm.frozen import FULL_STATES, NAMES, STATE_STEPS
from tests.model.driving.pdm.worlds import PLANS, case

NUDGE = 1e-6
"""States are moved by this much to see which plans lie near a boundary."""


def freeze(
    version: Literal["v1.1", "v2.2"], commit: str, out: Path, seeds: range, folders: list[Path]
) -> None:
    """Write one version's part of the fixture."""
    oracle = NavsimScorer(version, folders)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(PLANS, STEPS + 1, STATE_SIZE))
    kept: dict[str, list[Array | BoolArray]] = {}

    def keep(**found: Array | BoolArray) -> None:
        for name, value in found.items():
            kept.setdefault(name, []).append(value)

    for seed in seeds:
        drawn = case(seed)
        states = oracle.simulate(drawn.world, [drawn.reference, *drawn.plans, drawn.human, drawn.previous])
        scores = oracle.score(drawn.world, states[:-1])
        own = states[1 : PLANS + 1]
        keep(scores=scores[:PLANS], near=_near(drawn.world, own, signs, version))
        if version == "v2.2":
            keep(states=own[:, STATE_STEPS], extended=oracle.extended_comfort(own, states[-1]))
            keep(human=scores[PLANS])
            if seed < FULL_STATES:
                keep(states_full=own)
        if seed % 50 == 49:
            print(version, seed + 1, np.mean(kept["scores"], axis=(0, 1)).round(2), flush=True)
    about = {
        "oracle": "github.com/autonomousvision/navsim",
        "version": version,
        "commit": commit,
        "near_m": NUDGE,
        "sub_scores": NAMES,
        "state_steps": STATE_STEPS,
        "extended": "beside the plan of half a second ago",
    }
    _write(out, json.dumps(about), {name: np.array(rows) for name, rows in kept.items()})


def join(out: Path, parts: list[Path]) -> None:
    """Put parts together, in their order."""
    read: list[Any] = [np.load(part) for part in parts]
    arrays = {
        name: np.concatenate([part[name] for part in read if name in part])
        for name in read[0]
        if name != "about"
    }
    _write(out, str(read[0]["about"]), arrays)


def _write(out: Path, about: str, arrays: dict[str, Any]) -> None:
    np.savez_compressed(out, **{"about": np.array(about), **arrays})


def _near(world: World, states: Array, signs: Array, version: Literal["v1.1", "v2.2"]) -> BoolArray:
    """Which plans change a sub-score when their states move by `NUDGE`."""

    def found(moved: Array) -> Array:
        subs = score_states(world, moved, version).sub_scores
        return np.stack([value for value in subs.values() if value is not None])

    as_is = found(states)
    moved = [found(states + sign * NUDGE * signs) for sign in (1, -1)]
    near: BoolArray = np.logical_or.reduce([(each != as_is).any(axis=0) for each in moved])
    return near


if __name__ == "__main__":
    what, *given = sys.argv[1:]
    if what == "join":
        join(Path(given[0]), list(map(Path, given[1:])))
    else:
        commit, out, first, end, *folders = given
        version: Any = what
        freeze(version, commit, Path(out), range(int(first), int(end)), list(map(Path, folders)))
